// The viewer: what is shown, and how mouse and panel change it.

const byId = (id) => document.getElementById(id);
const SHADERS = CONTENT.shaders;
// Seconds of drawing after which the page answers; frames after which nothing moves any more; smallest scale of
// coarse pictures, also that of the first one.
const SLOW = 0.06,
  STILL = 4,
  COARSEST = 0.15;
// Seconds in which the light of the first view swings to both sides, once, and by how many degrees.
const SWING = 20,
  AMPLITUDE = 50;

class Viewer {
  constructor(content) {
    Object.assign(this, { content, materials: [], scale: COARSEST, full: 1, chosen: 0, still: 0 });
    this.renderer = new Renderer(byId("canvas"));
    this.state = stateOf("");
    this.camera = new Camera();
  }

  async start() {
    for (const material of this.content.materials)
      this.materials.push(await Material.load(this.renderer.gl, material));
    this.pictures = await Promise.all((this.content.pictures ?? []).map((picture) => this._picture(picture)));
    this.restore(location.hash);
  }

  // Take over the choices of a link's fragment.
  restore(fragment) {
    const { state, camera } = this;
    Object.assign(state, stateOf(fragment));
    Object.assign(camera, new Camera(state.camera));
    camera.elevation = Math.max(camera.elevation, this.lowest);
    state.material = clamp(Math.round(state.material), 0, this.materials.length - 1);
    if (!this.picture && !this.shown[1]) state.against = "none";
    Object.assign(this, { chosen: 0, swing: undefined });
    // A link shows what its author chose.
    if (fragment.length < 2 && !matchMedia("(prefers-reduced-motion: reduce)").matches)
      this.swing = performance.now();
    this.shapeChanged();
    this.environmentChanged();
    this.againstChanged();
    this.refresh?.();
  }

  async _picture(picture) {
    const [{ rows, columns, planes }] = await unpack(picture.roots),
      values = new Float32Array(4 * rows * columns).fill(1);
    // Row 0 of a picture is its top; square roots are stored.
    for (let j = 0; j < rows; j++)
      for (let i = 0; i < columns; i++)
        for (let c = 0; c < 3; c++)
          values[4 * ((rows - 1 - j) * columns + i) + c] = planes[c][j * columns + i] ** 2;
    return { ...picture, rows, columns, values };
  }

  get material() {
    return this.materials[this.state.material];
  }

  get shown() {
    const other = /^material (\d+)$/.exec(this.state.against);
    return other && this.materials[other[1]] ? [this.material, this.materials[other[1]]] : [this.material];
  }

  get picture() {
    const found = /^picture (\d+)$/.exec(this.state.against);
    return found ? this.pictures[found[1]] : undefined;
  }

  // Smallest elevation of the camera.
  get lowest() {
    return this.state.shape === "plane" ? 2 : -85;
  }

  get scene() {
    return {
      camera: this.camera,
      lights: this.state.lights,
      environment: this.state.environment,
      divide: this.state.divide,
    };
  }

  changed() {
    this.renderer.restart();
    this.still = 0;
    this.saveLater();
  }

  // Move the light of the first view; it ends where it began. Its elevation, and so the irradiance, stays, and
  // the mirror direction of the view is far: nothing is overexposed.
  moveLight() {
    if (this.swing === undefined) return;
    const turns = Math.min((performance.now() - this.swing) / (1000 * SWING), 1),
      [x0, y0, z] = FIRST.lights[0].direction,
      angle = Math.atan2(y0, x0) + radians(AMPLITUDE) * Math.sin(2 * Math.PI * turns),
      radius = Math.hypot(x0, y0);
    this.state.lights[0].direction = [radius * Math.cos(angle), radius * Math.sin(angle), z];
    if (turns === 1) this.stopLight();
    this.changed();
    this.refresh?.();
  }

  // The user moves light and picture from now on.
  stopLight() {
    this.swing = undefined;
  }

  saveLater() {
    clearTimeout(this.saving);
    this.saving = setTimeout(() => history.replaceState(null, "", linkOf(this.state, this.camera)), 300);
  }

  shapeChanged() {
    const { shape, tiles } = this.state,
      mesh = this.content.mesh;
    this.renderer.setShape((aspect) =>
      mesh && shape === mesh.name ? userShape(mesh, tiles, aspect) : SHAPES[shape](tiles, aspect),
    );
    this.changed();
  }

  // Put the camera where the whole shape is seen.
  frameShape() {
    const plane = this.state.shape === "plane",
      { aspect } = this.material.content,
      { camera, renderer } = this;
    Object.assign(camera, {
      target: plane ? [0.5, 0.5 * aspect, 0] : [0, 0, 0],
      tiles_across: this.state.tiles,
      elevation: plane ? 50 : 20,
      azimuth: -90,
    });
    if (!plane) camera.fit(renderer.shape(aspect).positions, renderer.canvas.width / renderer.canvas.height);
    this.changed();
  }

  environmentChanged() {
    const { name } = this.state.environment;
    this.renderer.setEnvironment(name === "none" ? undefined : environmentOf(name, this.content.environment));
    this.changed();
  }

  // A picture fixes view, light and shape; its values are M for unit irradiance of the plane.
  againstChanged() {
    const { gl } = this.renderer,
      picture = this.picture;
    if (picture) this.stopLight();
    if (this.pictureTexture) gl.deleteTexture(this.pictureTexture.handle);
    this.pictureTexture = undefined;
    if (picture) {
      const direction = picture.light,
        light = this.state.lights[0] ?? FIRST.lights[0];
      this.state.lights = [{ ...light, color: [1, 1, 1], direction }];
      this.state.environment.name = "none";
      this.environmentChanged();
      this.state.shape = "plane";
      this.shapeChanged();
      const { elevation, azimuth, tiles_across, target, field_of_view } = picture.camera;
      Object.assign(this.camera, {
        elevation,
        // Seen from straight above, the picture's up is +v.
        azimuth: elevation > 89.9 ? -90 : azimuth,
        tiles_across,
        field_of_view,
        target: [target[0], target[1], 0],
      });
      const factor = light.intensity * direction[2];
      this.pictureTexture = tableTexture(
        gl,
        picture.columns,
        picture.rows,
        picture.values.map((x, k) => (k % 4 < 3 ? x * factor : x)),
      );
    } else this.camera.field_of_view = new Camera().field_of_view;
    this.layout();
    this.changed();
  }

  // Size of the canvas: that of its place, or the proportions of the picture beside it.
  layout() {
    const { canvas } = this.renderer,
      box = canvas.parentElement.getBoundingClientRect();
    const proportion = this.picture ? this.picture.columns / this.picture.rows : box.width / box.height;
    const width = Math.min(box.width, box.height * proportion),
      height = width / proportion;
    const left = (box.width - width) / 2,
      top = (box.height - height) / 2;
    Object.assign(canvas.style, {
      inset: "auto",
      width: `${width}px`,
      height: `${height}px`,
      left: `${left}px`,
      top: `${top}px`,
    });
    for (const [id, side] of Object.entries({ left_name: "left", right_name: "right" }))
      Object.assign(byId(id).style, { [side]: `${left + 12}px`, top: `${top + 8}px` });
    const density = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(width * density));
    canvas.height = Math.max(1, Math.round(height * density));
    byId("divider").style.left = `${left + width * this.state.divide}px`;
    this.changed();
  }

  // Draw: coarse pictures while something moves, then frames of full size in parts, so that the page answers.
  // Returns whether anything changed.
  draw() {
    this.moveLight();
    const { renderer, shown, scene } = this,
      { width, height } = renderer.canvas,
      moving = this.still++ < STILL;
    const name = moving ? "coarse" : "full",
      scale = moving ? this.scale : 1;
    const mean = renderer.mean(
      name,
      Math.max(2, Math.round(width * scale)),
      Math.max(2, Math.round(height * scale)),
      shown.length,
    );
    const rows = moving
      ? mean.height
      : Math.max(2, Math.round((mean.height * SLOW) / Math.max(this.full, SLOW)));
    const before = performance.now(),
      drawn = renderer.frame(mean, shown, scene, rows);
    if (!drawn) return false;
    const seconds = (performance.now() - before) / 1000;
    // Time of a full frame, from the part that was drawn.
    this.full = moving ? seconds / (scale * scale) : (seconds * mean.height) / Math.min(rows, mean.height);
    this.seconds = moving ? seconds : this.full;
    if (moving) this.scale = clamp(Math.sqrt(SLOW / this.full), COARSEST, 1);
    // Until the first full frame is complete, the coarse picture stays.
    if (mean.frames) this._show(mean);
    return true;
  }

  _show(mean) {
    if (this.state.exposure === null) this._expose(mean);
    this.renderer.show(mean, this.state.exposure, this.state.divide, this.pictureTexture);
  }

  // The exposure that shows the 95th percentile of the mean channel as 0.8, as `--exposure auto` does.
  _expose(mean) {
    const values = [];
    mean.columns(this.state.divide).forEach(([first, count], side) => {
      if (!mean.sides[side] || !count) return;
      const pixels = mean.sides[side][0].read(first, 0, count, mean.height);
      for (let k = 0; k < pixels.length; k += 4)
        if (pixels[k + 3] > 0) values.push((pixels[k] + pixels[k + 1] + pixels[k + 2]) / 3);
    });
    const bright = values.sort((a, b) => a - b)[Math.round(0.95 * (values.length - 1))],
      stops = bright > 0 ? clamp(Math.log2(0.8 / bright), ...RANGES.exposure) : 0;
    this.state.exposure = Math.round(100 * stops) / 100;
    this.refresh?.();
  }

  // Show the last picture again.
  redraw() {
    const { full, coarse } = this.renderer.means,
      mean = full?.frames ? full : coarse;
    if (mean?.frames) this._show(mean);
  }
}
