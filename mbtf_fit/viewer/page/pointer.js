// Mouse, fingers and keys on the picture, the dividing line and the dome of lights.

// What one pointer does on an element, from pressing to releasing: `begin` returns a function of its moves.
function drag(element, begin) {
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    const moved = begin(event);
    element.addEventListener("pointermove", moved);
    const end = () => element.removeEventListener("pointermove", moved);
    for (const name of ["pointerup", "pointercancel"]) element.addEventListener(name, end, { once: true });
  });
}

function bindDome(viewer) {
  const dome = byId("dome"),
    { state } = viewer;
  drag(dome, (event) => {
    viewer.stopLight();
    const at = domeDirection(dome, event);
    const near = state.lights.map(({ direction }) => Math.hypot(direction[0] - at[0], direction[1] - at[1]));
    viewer.chosen = Math.max(0, near.indexOf(Math.min(...near)));
    const move = (next) => {
      if (!state.lights.length || viewer.picture) return;
      state.lights[viewer.chosen].direction = domeDirection(dome, next);
      viewer.changed();
      viewer.refresh();
    };
    move(event);
    viewer.refresh();
    return move;
  });
}

function bindDivider(viewer) {
  drag(byId("divider"), () => (next) => {
    const box = viewer.renderer.canvas.getBoundingClientRect();
    viewer.state.divide = clamp((next.clientX - box.left) / box.width, ...RANGES.divide);
    viewer.layout();
  });
}

// One pointer turns the view or moves picture or light; two zoom and move the picture.
function bindCanvas(viewer) {
  const { canvas } = viewer.renderer,
    { camera, state } = viewer,
    pointers = new Map();
  const orbit = (right, up) => camera.orbit(right, up, viewer.lowest);
  let first,
    far = 0;
  const one = (dx, dy, box) => {
    const light = state.lights[viewer.chosen];
    if (first.shiftKey && light) {
      viewer.stopLight();
      const [elevation, azimuth] = toAngles(light.direction);
      light.direction = fromAngles(
        clamp(elevation - (90 * dy) / box.height, 1, 89.9),
        azimuth + (180 * dx) / box.width,
      );
    } else if (first.button === 2 || first.ctrlKey) camera.pan(dx / box.width, -dy / box.width);
    else orbit((180 * dx) / box.width, (120 * dy) / box.height);
  };
  const two = (before, after, other, box) => {
    const [from, to] = [before, after].map(({ x, y }) => Math.hypot(x - other.x, y - other.y)),
      factor = clamp(from / Math.max(to, 1), 0.5, 2);
    // What lies between the fingers stays there.
    const x = (after.x + other.x) / 2 - box.left - box.width / 2,
      y = (after.y + other.y) / 2 - box.top - box.height / 2;
    camera.zoom(factor);
    camera.pan(
      ((after.x - before.x) / 2 + x * (1 - 1 / factor)) / box.width,
      -((after.y - before.y) / 2 + y * (1 - 1 / factor)) / box.width,
    );
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (!pointers.size) [first, far] = [event, 0];
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size > 1) far = Infinity;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId),
      after = { x: event.clientX, y: event.clientY };
    if (!before) return;
    pointers.set(event.pointerId, after);
    far += Math.abs(after.x - before.x) + Math.abs(after.y - before.y);
    if (viewer.picture || pointers.size > 2) return;
    const box = canvas.getBoundingClientRect(),
      other = [...pointers].find(([id]) => id !== event.pointerId);
    if (other) two(before, after, other[1], box);
    else one(after.x - before.x, after.y - before.y, box);
    viewer.changed();
    viewer.refresh();
  });
  canvas.addEventListener("pointerup", (event) => {
    if (!pointers.delete(event.pointerId)) return;
    const box = canvas.getBoundingClientRect();
    if (far < 4 && first.button === 0 && !first.shiftKey)
      showPoint(viewer, (event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
  });
  canvas.addEventListener("pointercancel", (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      if (viewer.picture) return;
      camera.zoom(2 ** (clamp(event.deltaY, -200, 200) / 400));
      viewer.changed();
      viewer.refresh();
    },
    { passive: false },
  );
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] }[event.key];
    if (viewer.picture) return;
    if (step) orbit(...step);
    else if (event.key === "+") camera.zoom(0.8);
    else if (event.key === "-") camera.zoom(1.25);
    else return;
    event.preventDefault();
    viewer.changed();
    viewer.refresh();
  });
}
