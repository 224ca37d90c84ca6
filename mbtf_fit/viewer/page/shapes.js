// Shapes to put the material on. Lengths are in tile widths; (u, v) counts tiles.

function meshOf(gl, { positions, normals, tangents, uvs, indices }) {
  const array = gl.createVertexArray(),
    buffers = [];
  const fill = (target, data) => {
    buffers.push(gl.createBuffer());
    gl.bindBuffer(target, buffers.at(-1));
    gl.bufferData(target, data, gl.STATIC_DRAW);
  };
  gl.bindVertexArray(array);
  [
    [positions, 3],
    [normals, 3],
    [tangents, 4],
    [uvs, 2],
  ].forEach(([data, size], k) => {
    fill(gl.ARRAY_BUFFER, new Float32Array(data));
    gl.enableVertexAttribArray(k);
    gl.vertexAttribPointer(k, size, gl.FLOAT, false, 0, 0);
  });
  fill(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(indices));
  gl.bindVertexArray(null);
  return { array, buffers, count: indices.length };
}

// A grid of a parametric surface: at(s, t) in [0, 1]² gives {p, n, t, uv}.
function gridOf(columns, rows, at) {
  const out = { positions: [], normals: [], tangents: [], uvs: [], indices: [] };
  for (let j = 0; j <= rows; j++)
    for (let i = 0; i <= columns; i++) {
      const { p, n, t, uv } = at(i / columns, j / rows);
      out.positions.push(...p);
      out.normals.push(...n);
      out.tangents.push(...t, 1);
      out.uvs.push(...uv);
      if (i === columns || j === rows) continue;
      const k = j * (columns + 1) + i,
        above = k + columns + 1;
      out.indices.push(k, k + 1, above + 1, k, above + 1, above);
    }
  return out;
}

// A horizontal square around the center of the first tile. Rasterizers snap vertices to fractions of a pixel:
// many small triangles keep positions exact.
function planeShape(tiles, aspect) {
  const side = Math.max(4 * tiles, 400);
  return gridOf(32, 32, (s, t) => {
    const p = [0.5 + (s - 0.5) * side, aspect * 0.5 + (t - 0.5) * side, 0];
    return { p, n: [0, 0, 1], t: [1, 0, 0], uv: [p[0], p[1] / aspect] };
  });
}

// A sphere whose equator has so many tiles.
function sphereShape(tiles, aspect) {
  const around = Math.max(1, Math.round(tiles)),
    radius = around / (2 * Math.PI);
  const up = Math.max(1, Math.round(around / 2 / aspect));
  return gridOf(128, 64, (s, t) => {
    const [a, e] = [2 * Math.PI * s, Math.PI * (t - 0.5)];
    const n = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    return { p: scaled(n, radius), n, t: [-Math.sin(a), Math.cos(a), 0], uv: [around * s, up * t] };
  });
}

// A hanging cloth of so many tiles along each side, with folds.
function clothShape(tiles, aspect) {
  const depth = (s, t) => 0.06 * (1.2 - t) * (Math.sin(9 * s + 1.5 * t) + 0.4 * Math.sin(21 * s - 2 * t));
  return gridOf(160, 80, (s, t) => {
    const h = 1e-3,
      by_s = (depth(s + h, t) - depth(s - h, t)) / (2 * h),
      by_t = (depth(s, t + h) - depth(s, t - h)) / (2 * h);
    const n = normalized([by_s, -1, by_t]),
      tangent = normalized([1, by_s, 0]);
    const p = [(s - 0.5) * tiles, depth(s, t) * tiles, (t - 0.5) * tiles];
    return {
      p,
      n: normalized(cross(tangent, normalized([0, by_t, 1]))),
      t: tangent,
      uv: [tiles * s, (tiles * t) / aspect],
    };
  });
}

// The user's mesh, so many tiles per unit of its texture coordinates.
function userShape(mesh, tiles, aspect) {
  const [positions, normals, tangents, uvs] = ["positions", "normals", "tangents", "uvs"].map((k) =>
    floatsOf(mesh[k]),
  );
  const size = tiles * mesh.unit;
  return {
    positions: positions.map((x) => x * size),
    normals,
    tangents,
    uvs: uvs.map((x, k) => x * (k % 2 ? tiles / aspect : tiles)),
    indices: new Uint32Array(bytesOf(mesh.indices).buffer),
  };
}

const SHAPES = { plane: planeShape, sphere: sphereShape, cloth: clothShape };
