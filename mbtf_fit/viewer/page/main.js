// Start: read the page's content, test the device, draw.

const fail = (error) => (byId("message").textContent = error.message || String(error));

const timeText = (seconds) =>
  seconds < 0.95 ? `${Math.max(1, Math.round(1000 * seconds))} ms` : `${Math.round(seconds)} s`;

function statusLine(viewer, test) {
  const { renderer, camera, material, full } = viewer,
    pitch = camera.tiles_across / renderer.canvas.width,
    finest = material.content.finest,
    level = clamp(-Math.log2(pitch), 0, finest),
    texels = Number((pitch * 2 ** finest).toPrecision(2));
  const { frames = 0, row = 0, height = 1 } = renderer.means.full ?? {};
  // The first full frame replaces the coarse picture; more of them remove its noise and jagged edges.
  let progress = "preview in low resolution";
  if (frames >= FRAMES) progress = "picture complete";
  else if (frames) progress = `smoothing edges: frame ${frames} of ${FRAMES}, ${timeText(full)} each`;
  else if (row)
    progress = `drawing in full resolution: ${Math.floor((100 * row) / height)}%${full < 1 ? "" : ` of ${timeText(full)}`}`;
  const beyond = test?.beyond
    ? `, ${test.beyond} of ${test.count} test queries deviate, by up to ${Number((100 * test.largest).toPrecision(2))}%`
    : test
      ? `, all ${test.count} test queries agree`
      : "";
  return `${tilesText(camera.tiles_across)} across, a pixel is ${texels} texel${texels === 1 ? "" : "s"} wide (level ${level.toFixed(1)} of ${finest}), ${progress}${beyond}`;
}

// Until the browser has shown what has changed.
const painted = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done)));

async function show(content) {
  // A link shows another view than the poster's.
  if (content.poster && location.hash.length < 2)
    byId("poster").style.backgroundImage = `url(${content.poster})`;
  const viewer = new Viewer(content);
  await viewer.start();
  bindPanel(viewer);
  viewer.layout();
  byId("message").textContent = "Compiling shaders …";
  await painted();
  viewer.draw();
  byId("poster").remove();
  byId("message").textContent = "";
  await painted();
  const tests = viewer.materials.map((material) => testQueries(viewer.renderer, material));
  // For tests and scripts.
  window.mbtf = { viewer, tests, showPoint };
  window.addEventListener("hashchange", () => viewer.restore(location.hash));
  const loop = () => {
    if (viewer.draw()) byId("status").textContent = statusLine(viewer, tests[viewer.state.material]);
    requestAnimationFrame(loop);
  };
  requestAnimationFrame(loop);
}

byId("canvas").addEventListener("webglcontextlost", () =>
  fail(new Error("The graphics card was reset. Load the page again.")),
);
window.addEventListener("error", (event) => fail(event.error ?? new Error(event.message)));
show(CONTENT).catch((error) => {
  fail(error);
  byId("panel").hidden = true;
});
