// Draws the scene: frames accumulate to a mean, which is displayed with exposure.

const FRAMES = 64;
const BACKGROUND = [0.11, 0.12, 0.14].map(decoded);

// Halton sequence, for positions within the pixel.
function halton(index, base) {
  let [out, factor] = [0, 1];
  for (let k = index; k > 0; k = Math.floor(k / base)) {
    factor /= base;
    out += factor * (k % base);
  }
  return out;
}

// Pictures of one size: the latest frame, and the running mean of each side.
class Mean {
  constructor(gl, width, height, sides) {
    Object.assign(this, { width, height, frames: 0, row: 0 });
    this.latest = new Target(gl, width, height, true);
    this.sides = Array.from({ length: sides }, () => [0, 1].map(() => new Target(gl, width, height)));
  }

  restart() {
    this.frames = this.row = 0;
  }

  // First column and number of columns of each side.
  columns(divide) {
    const split = this.sides.length > 1 ? Math.round(divide * this.width) : this.width;
    return [
      [0, split],
      [split, this.width - split],
    ];
  }

  delete() {
    for (const target of [this.latest, ...this.sides.flat()]) target.delete();
  }
}

class Renderer {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = openContext(canvas);
    this.empty = this.gl.createVertexArray();
    this.accumulate = new Program(this.gl, SHADERS["screen.vert"], SHADERS["accumulate.frag"]);
    this.display = new Program(this.gl, SHADERS["screen.vert"], SHADERS["display.frag"]);
    this.means = {};
    this.meshes = new Map();
  }

  drawScreen() {
    this.gl.bindVertexArray(this.empty);
    this.gl.drawArrays(this.gl.TRIANGLES, 0, 3);
  }

  // `shape` gives the data of a mesh for the aspect of a material's tile.
  setShape(shape) {
    for (const { array, buffers } of this.meshes.values()) {
      buffers.forEach((buffer) => this.gl.deleteBuffer(buffer));
      this.gl.deleteVertexArray(array);
    }
    this.meshes.clear();
    this.shape = shape;
  }

  _mesh(aspect) {
    if (!this.meshes.has(aspect)) this.meshes.set(aspect, meshOf(this.gl, this.shape(aspect)));
    return this.meshes.get(aspect);
  }

  setEnvironment(table) {
    if (this.environment) this.gl.deleteTexture(this.environment.handle);
    this.lit = Boolean(table);
    // A sampler must have some texture.
    const { width, height, data } = table ?? { width: 1, height: 1, data: null };
    this.environment = tableTexture(this.gl, width, height, data);
  }

  restart() {
    for (const mean of Object.values(this.means)) mean.restart();
  }

  // The mean of a name ("full", or "coarse" while something moves), made anew for another size.
  mean(name, width, height, sides) {
    const known = this.means[name];
    if (known && known.width === width && known.height === height && known.sides.length === sides)
      return known;
    known?.delete();
    return (this.means[name] = new Mean(this.gl, width, height, sides));
  }

  _scene(material, target, scene, values, region) {
    const { gl } = this,
      { camera, lights, environment } = scene;
    target.begin();
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...region);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    material.use(
      material.program("scene.vert", "scene.frag"),
      {
        view_projection: camera.viewProjection(target.width / target.height),
        camera: camera.position,
        light_count: lights.length,
        light_direction: lights.flatMap((light) => light.direction),
        light_color: lights.flatMap((light) => light.color.map((c) => c * light.intensity)),
        has_environment: this.lit ? 1 : 0,
        environment_angle: radians(environment.angle),
        environment_color: [1, 1, 1].map((c) => c * environment.intensity),
        frame: 0,
        shown: 0,
        jitter: [0, 0],
        ...values,
      },
      { environment_samples: this.environment },
    );
    const { array, count } = this._mesh(material.content.aspect);
    gl.bindVertexArray(array);
    gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
    gl.disable(gl.SCISSOR_TEST);
    gl.disable(gl.DEPTH_TEST);
  }

  // Draw some rows of the next frame of each material; a complete frame joins the mean. Returns false once all
  // frames are there.
  frame(mean, materials, scene, rows) {
    const { width, height, frames: n } = mean;
    if (n >= FRAMES) return false;
    // The pixel's filter is that of the footprint: the first frame is not jittered.
    const jitter = n ? [(2 * halton(n, 2) - 1) / width, (2 * halton(n, 3) - 1) / height] : [0, 0];
    const count = Math.min(rows, height - mean.row),
      last = mean.row + count >= height;
    const columns = mean.columns(scene.divide);
    materials.forEach((material, side) => {
      const [first, across] = columns[side];
      this._scene(material, mean.latest, scene, { jitter, frame: n }, [first, mean.row, across, count]);
      const { gl } = this,
        [known, next] = mean.sides[side];
      next.begin();
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(0, mean.row, width, count);
      this.accumulate.use({ weight: 1 / (n + 1) });
      this.accumulate.bind({ mean: known.texture, latest: mean.latest.texture });
      this.drawScreen();
      gl.disable(gl.SCISSOR_TEST);
      if (last) mean.sides[side] = [next, known];
    });
    mean.row = last ? 0 : mean.row + count;
    mean.frames += last ? 1 : 0;
    // Reading a pixel waits for the graphics card.
    mean.latest.read(0, 0, 1, 1);
    return true;
  }

  // Show means on the canvas; `picture` takes the place of the second.
  show(mean, exposure, divide, picture) {
    const { gl, canvas } = this,
      [first, other] = mean.sides.map(([known]) => known.texture),
      second = picture ?? other;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    this.display.use({
      exposure,
      divide: second ? divide : 1,
      size: [canvas.width, canvas.height],
      background: BACKGROUND,
    });
    this.display.bind({ first, second: second ?? first });
    this.drawScreen();
  }

  // Position, footprint and view of the material at a place of the picture (from the top left); null beside
  // the shape.
  pick(material, scene, x, y) {
    const { width, height } = this.canvas,
      target = new Target(this.gl, width, height, true);
    const at = [
      clamp(Math.floor(x * width), 0, width - 1),
      clamp(Math.floor((1 - y) * height), 0, height - 1),
    ];
    // Derivatives need the neighbors.
    const region = [at[0] & ~1, at[1] & ~1, 2, 2];
    const [[u, v, sigma, hit], omega_o] = [1, 2].map((shown) => {
      this._scene(material, target, scene, { shown }, region);
      return [...target.read(...at, 1, 1)];
    });
    target.delete();
    return hit ? { u: [u, v], sigma, omega_o: omega_o.slice(0, 3) } : null;
  }

  // M over the disk of lights, or of views: RGBA floats, `size` pixels along each side, row 0 below.
  overDirections(material, size, { u, sigma }, omega, over_views) {
    if (!this.disk || this.disk.width !== size) this.disk = new Target(this.gl, size, size);
    this.disk.begin();
    material.use(material.program("screen.vert", "directions.frag"), {
      u,
      sigma,
      omega,
      over_views: over_views ? 1 : 0,
    });
    this.drawScreen();
    return this.disk.read(0, 0, size, size);
  }
}
