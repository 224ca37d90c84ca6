// A material on the graphics card: its textures and weights, and programs that evaluate it.

const HEAD =
  "#version 300 es\nprecision highp float;\nprecision highp int;\nprecision highp sampler2D;\nprecision highp sampler2DArray;\n";

// Textures of an image's levels, by its layout (mbtf_fit/backends/shader/images.py).
const layered = (layers) => (gl, image, levels) =>
  layeredTexture(gl, stack(levels, layers(levels[0].planes.length)), image.half);
const IMAGES = {
  plain: layered(plainLayers),
  maps: layered(mapLayers),
  horizons: layered((channels) => horizonLayers(channels / 2)),
  nodes: (gl, image, levels) => {
    const { width, height, data } = nodesOf(levels, image.shift);
    return tableTexture(gl, width, height, data);
  },
  rows: (gl, image) => tableTexture(gl, image.width, image.height, floatsOf(image.data)),
};

class Material {
  constructor(gl, content) {
    Object.assign(this, { gl, content, programs: {}, textures: {} });
    this.name = content.name;
  }

  static async load(gl, content) {
    const self = new Material(gl, content),
      names = Object.keys(content.textures);
    const unpacked = await Promise.all(names.map((name) => unpack(content.textures[name])));
    const levels = Object.fromEntries(names.map((name, k) => [name, unpacked[k]]));
    for (const image of content.images)
      self.textures[image.name] = IMAGES[image.layout](gl, image, levels[image.texture]);
    self._weigh(floatsOf(content.weights));
    return self;
  }

  // Weights are uniforms where they fit, which is faster; otherwise a texture.
  _weigh(weights) {
    const { gl } = this,
      count = weights.length / 4;
    this.uniform = 4 * weights.length <= gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE);
    if (this.uniform) {
      this.buffer = gl.createBuffer();
      gl.bindBuffer(gl.UNIFORM_BUFFER, this.buffer);
      gl.bufferData(gl.UNIFORM_BUFFER, weights, gl.STATIC_DRAW);
      this.header = `layout(std140) uniform Weights { vec4 weights[${count}]; };\n#define WEIGHT(i) weights[i]\n`;
    } else {
      const padded = new Float32Array(4 * 1024 * Math.ceil(count / 1024));
      padded.set(weights);
      this.textures.weight_texture = tableTexture(gl, 1024, padded.length / 4096, padded);
      this.header =
        "uniform sampler2D weight_texture;\n" +
        "#define WEIGHT(i) texelFetch(weight_texture, ivec2((i) & 1023, (i) >> 10), 0)\n";
    }
  }

  // Program of a fragment shader that calls the material's functions, made at its first use.
  program(vertex, fragment) {
    const key = `${vertex} ${fragment}`;
    this.programs[key] ??= new Program(
      this.gl,
      SHADERS[vertex],
      HEAD + this.header + this.content.source + SHADERS[fragment],
    );
    return this.programs[key];
  }

  use(program, values, textures = {}) {
    const { gl } = this;
    program.use({ min_cos: this.content.min_cos, ...values });
    program.bind({ ...this.textures, ...textures });
    if (!this.uniform) return;
    gl.uniformBlockBinding(program.handle, gl.getUniformBlockIndex(program.handle, "Weights"), 0);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, this.buffer);
  }
}

// Largest deviation of this device from the material's test queries, over max(1, value), and the number of
// queries beyond the tolerance.
function testQueries(renderer, material) {
  const { gl } = renderer,
    { conformance, tolerance } = material.content;
  const [u, sigma, light, view, expected] = ["u", "sigma", "omega_i", "omega_o", "rgb"].map((name) =>
    floatsOf(conformance[name]),
  );
  const count = sigma.length,
    table = new Float32Array(4 * 3 * count);
  for (let k = 0; k < count; k++) {
    table.set([u[2 * k], u[2 * k + 1], sigma[k]], 4 * k);
    table.set(light.subarray(3 * k, 3 * k + 3), 4 * (count + k));
    table.set(view.subarray(3 * k, 3 * k + 3), 4 * (2 * count + k));
  }
  const queries = tableTexture(gl, count, 3, table),
    target = new Target(gl, count, 1);
  target.begin();
  material.use(material.program("screen.vert", "queries.frag"), {}, { queries });
  renderer.drawScreen();
  const found = target.read(0, 0, count, 1);
  target.delete();
  gl.deleteTexture(queries.handle);
  const deviations = [];
  for (let k = 0; k < count; k++)
    for (let c = 0; c < 3; c++) {
      const value = expected[3 * k + c];
      deviations.push(Math.abs(found[4 * k + c] - value) / Math.max(1, value));
    }
  const beyond = new Set();
  deviations.forEach((d, k) => {
    if (!(d <= tolerance)) beyond.add(Math.floor(k / 3));
  });
  return { count, largest: Math.max(...deviations), beyond: beyond.size, values: [...found] };
}
