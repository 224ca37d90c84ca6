// Start: read the page's content, test the device, draw.

const fail = (error) => (byId("message").textContent = error.message || String(error));

function statusLine(viewer, test) {
  const { renderer, camera, material, seconds } = viewer,
    pitch = camera.tiles_across / renderer.canvas.width;
  const level = clamp(-Math.log2(pitch), 0, material.content.finest);
  const beyond = test?.beyond ? `, ${test.beyond} of ${test.count} test queries deviate` : "";
  return `level ${level.toFixed(1)} of ${material.content.finest}, ${camera.tiles_across.toPrecision(2)} tiles across, ${(1000 * seconds).toFixed(0)} ms per frame${beyond}`;
}

async function show(content) {
  const viewer = new Viewer(content);
  await viewer.start();
  bindPanel(viewer);
  viewer.layout();
  const tests = viewer.materials.map((material) => testQueries(viewer.renderer, material));
  viewer.draw();
  byId("message").textContent = "";
  // For tests and scripts.
  window.mbtf = { viewer, tests, showPoint };
  const loop = () => {
    if (viewer.draw()) byId("status").textContent = statusLine(viewer, tests[viewer.state.material]);
    requestAnimationFrame(loop);
  };
  requestAnimationFrame(loop);
  return viewer;
}

byId("canvas").addEventListener("webglcontextlost", () =>
  fail(new Error("The graphics card was reset. Load the page again.")),
);
window.addEventListener("error", (event) => fail(event.error ?? new Error(event.message)));
if (CONTENT.live) {
  byId("message").textContent = "Waiting for the first material …";
  follow((material) => show({ ...CONTENT, materials: [material] }));
} else show(CONTENT).catch(fail);
