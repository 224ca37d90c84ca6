// Messages of a command that is running: stages, curves, materials and pictures as they come.

const CURVES = { loss: "#7f8792", unexplained: "#4da3ff" };

function tableOf(id, rows) {
  byId(id).replaceChildren(
    ...rows.map((cells) => {
      const row = document.createElement("tr");
      for (const cell of cells) row.insertCell().textContent = cell;
      return row;
    }),
  );
}

// Loss and validation error over the seconds, both axes logarithmic.
function drawCurves(canvas, records) {
  const ink = canvas.getContext("2d"),
    { width, height } = canvas;
  ink.clearRect(0, 0, width, height);
  const points = (key) =>
    records.filter((r) => r[key] > 0 && r.seconds > 0).map((r) => [Math.log(r.seconds), Math.log(r[key])]);
  const all = Object.keys(CURVES).flatMap(points);
  if (!all.length) return;
  const range = (k) => {
    const values = all.map((p) => p[k]),
      low = Math.min(...values),
      high = Math.max(...values);
    return [low, Math.max(high - low, 0.1)];
  };
  const [[x0, dx], [y0, dy]] = [range(0), range(1)];
  const at = ([x, y]) => [50 + ((x - x0) / dx) * (width - 65), height - 35 - ((y - y0) / dy) * (height - 55)];
  ink.font = "22px sans-serif";
  ink.fillStyle = "#9aa0a8";
  for (const share of [0, 1]) {
    ink.fillText(Math.exp(y0 + share * dy).toPrecision(2), 2, height - 30 - share * (height - 55));
    ink.fillText(`${Math.exp(x0 + share * dx).toPrecision(2)} s`, 50 + share * (width - 130), height - 5);
  }
  for (const [key, color] of Object.entries(CURVES)) {
    ink.beginPath();
    points(key).forEach((p) => ink.lineTo(...at(p)));
    ink.strokeStyle = color;
    ink.lineWidth = 4;
    ink.stroke();
  }
}

// Follow a running command. `begin` makes the viewer of a first material.
function follow(begin) {
  const events = new EventSource("events"),
    on = (kind, act) =>
      events.addEventListener(kind, (event) => {
        const { name, content } = JSON.parse(event.data);
        act(content, name);
      });
  let viewer,
    waiting = Promise.resolve();
  // One after the other: materials may come faster than they are drawn.
  const next = (act) => (waiting = waiting.then(act).catch(fail));
  byId("live").hidden = false;
  on("stages", (stages) => tableOf("stages", Object.entries(stages)));
  on("curve", ({ records }, name) => {
    const last = records[records.length - 1],
      text = (x) => (x === null ? "undefined" : x.toPrecision(3));
    drawCurves(byId("curve"), records);
    byId("curve_text").textContent =
      `${name}: step ${last.step}, ${(100 * last.fraction).toFixed(0)}%, loss ${text(last.loss)} (gray), validation error ${text(last.unexplained)} (blue)`;
  });
  on("levels", (levels) =>
    tableOf("levels", [
      ["level", "validation error"],
      ...Object.entries(levels).map(([level, e]) => [level, e === null ? "undefined" : e.toPrecision(2)]),
    ]),
  );
  on("material", (content) =>
    next(async () => {
      if (viewer) await viewer.setMaterial(content);
      else viewer = await begin(content);
    }),
  );
  let pictures;
  on("pictures", (content) => {
    pictures = content;
    next(() => viewer?.setPictures(pictures));
  });
  on("end", () => {
    events.close();
    byId("curve_text").textContent += "; the command has ended";
    if (!viewer) next(() => viewer || fail(new Error("The command has ended without a material to show.")));
  });
  events.addEventListener("error", () => {
    if (!viewer) fail(new Error("The command that served this page has ended."));
  });
}
