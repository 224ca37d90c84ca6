// WebGL 2: context, programs, textures and targets.

function openContext(canvas) {
  const gl = canvas.getContext("webgl2", {
    antialias: false,
    alpha: false,
    powerPreference: "high-performance",
  });
  if (!gl)
    throw new Error(
      "This browser offers no WebGL 2, which draws the material. Turn on hardware acceleration, or open the page in another browser.",
    );
  if (!gl.getExtension("EXT_color_buffer_float"))
    throw new Error(
      "This browser cannot draw to textures of floats (EXT_color_buffer_float), which the page needs. Open it in another browser.",
    );
  return gl;
}

function compile(gl, kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  return shader;
}

// A program whose uniforms are set by name; names that it has not are ignored.
class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.handle = gl.createProgram();
    const parts = [compile(gl, gl.VERTEX_SHADER, vertex), compile(gl, gl.FRAGMENT_SHADER, fragment)];
    for (const part of parts) gl.attachShader(this.handle, part);
    ["position", "normal", "tangent", "uv"].forEach((name, k) => gl.bindAttribLocation(this.handle, k, name));
    gl.linkProgram(this.handle);
    if (!gl.getProgramParameter(this.handle, gl.LINK_STATUS)) {
      const log =
        parts.map((part) => gl.getShaderInfoLog(part)).join(" ") || gl.getProgramInfoLog(this.handle);
      throw new Error(`The graphics driver refused a shader: ${log.trim().split("\n")[0]}`);
    }
    this.uniforms = {};
    for (let k = 0; k < gl.getProgramParameter(this.handle, gl.ACTIVE_UNIFORMS); k++) {
      const { name, size, type } = gl.getActiveUniform(this.handle, k);
      const location = gl.getUniformLocation(this.handle, name);
      if (location) this.uniforms[name.replace("[0]", "")] = { location, size, type };
    }
  }

  use(values = {}) {
    this.gl.useProgram(this.handle);
    for (const [name, value] of Object.entries(values)) this.set(name, value);
  }

  set(name, value) {
    const { gl } = this,
      uniform = this.uniforms[name];
    if (!uniform) return;
    const { location, type } = uniform;
    const list = Array.isArray(value) || ArrayBuffer.isView(value) ? value : [value];
    if (!list.length) return;
    if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(location, false, list);
    else if (type === gl.FLOAT_VEC4) gl.uniform4fv(location, list);
    else if (type === gl.FLOAT_VEC3) gl.uniform3fv(location, list);
    else if (type === gl.FLOAT_VEC2) gl.uniform2fv(location, list);
    else if (type === gl.FLOAT) gl.uniform1fv(location, list);
    else gl.uniform1iv(location, list);
  }

  // Bind textures {name: {target, handle}} to units of their own.
  bind(textures) {
    const { gl } = this;
    let unit = 0;
    for (const [name, texture] of Object.entries(textures)) {
      if (!this.uniforms[name]) continue;
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(texture.target, texture.handle);
      gl.uniform1i(this.uniforms[name].location, unit++);
    }
  }
}

function unfiltered(gl, target) {
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(target, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, name, gl.CLAMP_TO_EDGE);
}

function checkSize(gl, ...sizes) {
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  if (Math.max(...sizes) > most)
    throw new Error(
      `The material needs textures of ${Math.max(...sizes)} texels; this device allows ${most}. Export a material of fewer levels.`,
    );
}

// Layers of four numbers; `half` stores 16-bit floats.
function layeredTexture(gl, { width, height, layers, data }, half) {
  checkSize(gl, width, height);
  const handle = gl.createTexture(),
    target = gl.TEXTURE_2D_ARRAY;
  gl.bindTexture(target, handle);
  gl.texImage3D(target, 0, half ? gl.RGBA16F : gl.RGBA32F, width, height, layers, 0, gl.RGBA, gl.FLOAT, data);
  unfiltered(gl, target);
  return { target, handle };
}

// A table (rows, columns) of four numbers.
function tableTexture(gl, width, height, data) {
  checkSize(gl, width, height);
  const handle = gl.createTexture(),
    target = gl.TEXTURE_2D;
  gl.bindTexture(target, handle);
  gl.texImage2D(target, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, data);
  unfiltered(gl, target);
  return { target, handle };
}

// Something to draw into: a texture of floats, with a depth buffer on request.
class Target {
  constructor(gl, width, height, depth = false) {
    Object.assign(this, { gl, width, height });
    this.texture = tableTexture(gl, width, height, null);
    this.handle = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.handle);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture.handle, 0);
    if (depth) {
      this.depth = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
    }
  }

  begin() {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, this.handle);
    this.gl.viewport(0, 0, this.width, this.height);
  }

  read(x, y, width, height) {
    const { gl } = this,
      out = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.handle);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.FLOAT, out);
    return out;
  }

  delete() {
    this.gl.deleteTexture(this.texture.handle);
    this.gl.deleteFramebuffer(this.handle);
    if (this.depth) this.gl.deleteRenderbuffer(this.depth);
  }
}
