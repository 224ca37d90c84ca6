// Small pictures: the lights seen from above, and values over the disk of directions.

// Lights as dots on the disk of their x and y, along u and v of the plane.
function drawDome(canvas, lights, chosen) {
  const ink = canvas.getContext("2d"),
    r = canvas.width / 2,
    size = 0.92 * r;
  ink.clearRect(0, 0, canvas.width, canvas.height);
  ink.strokeStyle = "#565b63";
  ink.fillStyle = "#2a2c31";
  for (const elevation of [0, 30, 60]) {
    ink.beginPath();
    ink.arc(r, r, size * Math.cos(radians(elevation)), 0, 2 * Math.PI);
    if (!elevation) ink.fill();
    ink.stroke();
  }
  ink.font = "34px sans-serif";
  ink.fillStyle = "#9aa0a8";
  ink.fillText("u", r + 0.76 * size, r + 10);
  ink.fillText("v", r - 9, r - 0.76 * size);
  lights.forEach(({ direction: [x, y], color }, k) => {
    ink.beginPath();
    ink.arc(r + size * x, r - size * y, k === chosen ? 15 : 11, 0, 2 * Math.PI);
    ink.fillStyle = `rgb(${color.map((c) => Math.round(255 * Math.sqrt(c))).join(" ")})`;
    ink.fill();
    ink.lineWidth = k === chosen ? 5 : 2;
    ink.strokeStyle = k === chosen ? "#4da3ff" : "#000";
    ink.stroke();
    ink.lineWidth = 2;
  });
}

// Direction of a place on the dome, at least a degree above the horizon.
function domeDirection(canvas, event) {
  const box = canvas.getBoundingClientRect();
  const x = (2 * (event.clientX - box.left)) / box.width - 1,
    y = 1 - (2 * (event.clientY - box.top)) / box.height;
  const length = Math.hypot(x, y) / 0.92,
    most = Math.cos(radians(1));
  const s = (length > most ? most / length : 1) / 0.92;
  return [x * s, y * s, Math.sqrt(Math.max(0, 1 - (x * s) ** 2 - (y * s) ** 2))];
}

// Values over directions: the largest is white; the chosen direction is a circle.
function drawValues(canvas, size, values, [x, y]) {
  canvas.width = canvas.height = size;
  const ink = canvas.getContext("2d"),
    image = ink.createImageData(size, size);
  let largest = 0;
  for (let k = 0; k < values.length; k += 4)
    largest = Math.max(largest, values[k], values[k + 1], values[k + 2]);
  for (let j = 0; j < size; j++)
    for (let i = 0; i < size; i++) {
      const from = 4 * ((size - 1 - j) * size + i),
        to = 4 * (j * size + i);
      for (let c = 0; c < 3; c++)
        image.data[to + c] = 255 * encoded(largest > 0 ? Math.max(0, values[from + c]) / largest : 0);
      image.data[to + 3] = 255;
    }
  ink.putImageData(image, 0, 0);
  ink.beginPath();
  ink.arc((size / 2) * (1 + x), (size / 2) * (1 - y), size / 32, 0, 2 * Math.PI);
  ink.strokeStyle = "#4da3ff";
  ink.lineWidth = size / 64;
  ink.stroke();
  return largest;
}
