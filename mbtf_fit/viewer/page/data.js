// Data of the page: numbers from base64, and textures as mbtf_fit/viewer/textures.py packs them.

function bytesOf(base64) {
  const text = atob(base64),
    bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return bytes;
}

const floatsOf = (base64) => new Float32Array(bytesOf(base64).buffer);

async function inflate(base64) {
  const stream = new Blob([bytesOf(base64)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Levels of a texture, coarsest first: {rows, columns, planes}, a Float32Array per channel.
async function unpack(texture) {
  const bytes = await inflate(texture.data),
    { channels, bits, alike } = texture;
  const largest = 2 ** bits - 1,
    total = bytes.length / (bits > 8 ? 2 : 1),
    levels = [];
  let at = 0;
  texture.shapes.forEach(([rows, columns], level) => {
    // Differences of channels may be negative, so they are kept as they are.
    const planes = [],
      whole = new Int32Array(rows * columns),
      sum = new Int32Array(rows * columns);
    for (let c = 0; c < channels; c++) {
      const low = texture.low[level][c],
        step = texture.step[level][c],
        plane = new Float32Array(rows * columns);
      for (let j = 0, n = 0; j < rows; j++) {
        for (let i = 0; i < columns; i++, n++, at++) {
          const difference = bits > 8 ? bytes[at] | (bytes[total + at] << 8) : bytes[at];
          let guess = 0;
          if (i && j) {
            const left = whole[n - 1],
              above = whole[n - columns],
              corner = whole[n - columns - 1];
            const least = Math.min(left, above),
              most = Math.max(left, above);
            guess = corner >= most ? least : corner <= least ? most : left + above - corner;
          } else if (i) guess = whole[n - 1];
          else if (j) guess = whole[n - columns];
          if (alike && c) {
            // The number is that of the channel before plus the difference, modulo 2^bits.
            const number = (sum[n] + difference + guess) & largest;
            whole[n] = number - sum[n];
            sum[n] = number;
          } else whole[n] = sum[n] = (difference + guess) & largest;
          plane[n] = low + step * sum[n];
        }
      }
      planes.push(plane);
    }
    levels.push({ rows, columns, planes });
  });
  if (at !== total) throw new Error("a texture has not as many numbers as its shape says");
  return levels;
}

// Layers of four channels of all levels, one level below the other: {width, height, layers, data}. `channels`
// lists what the four numbers of each layer are: functions of a level's planes and a texel's index.
function stack(levels, layers) {
  const width = Math.max(...levels.map((l) => l.columns)),
    height = levels.reduce((sum, l) => sum + l.rows, 0);
  const data = new Float32Array(4 * width * height * layers.length);
  layers.forEach((channels, layer) => {
    let start = layer * height;
    for (const { rows, columns, planes } of levels) {
      channels.forEach((read, c) => {
        for (let j = 0, n = 0; j < rows; j++) {
          let to = 4 * ((start + j) * width) + c;
          for (let i = 0; i < columns; i++, n++, to += 4) data[to] = read(planes, n);
        }
      });
      start += rows;
    }
  });
  return { width, height, layers: layers.length, data };
}

// All channels, four per layer.
function plainLayers(channels) {
  const layers = [];
  for (let c = 0; c < channels; c += 4)
    layers.push([0, 1, 2, 3].filter((k) => c + k < channels).map((k) => (planes, n) => planes[c + k][n]));
  return layers;
}

// Second moments are stored as standard deviations.
function mapLayers(channels) {
  const layers = plainLayers(channels);
  layers[0][2] = (p, n) => p[2][n] * p[2][n] + p[0][n] * p[0][n];
  layers[0][3] = (p, n) => p[3][n] + p[0][n] * p[1][n];
  layers[1][0] = (p, n) => p[4][n] * p[4][n] + p[1][n] * p[1][n];
  return layers;
}

// Mean and second moment of the horizon at an azimuth and at the next one.
function horizonLayers(azimuths) {
  const moment = (j) => (p, n) => p[azimuths + j][n] * p[azimuths + j][n] + p[j][n] * p[j][n];
  const mean = (j) => (p, n) => p[j][n];
  return Array.from({ length: azimuths }, (_, j) => {
    const next = (j + 1) % azimuths;
    return [mean(j), moment(j), mean(next), moment(next)];
  });
}

// Nodes of a periodic height field: each cell's surface, then the highest vertex of blocks of 2, 4, … cells
// (mbtf_core/height_planes.py). Row 0 of the heights is the side v → 1, row 0 of the nodes v → 0.
function nodesOf([{ rows, columns, planes: [heights] }], shift) {
  const z = (i, j) => Math.min(0, heights[(rows - 1 - ((j + rows) % rows)) * columns + (i % columns)]);
  const [wide, tall] = [columns, rows].map((n) => 32 - Math.clz32(n - 1)),
    size = rows * columns + (Math.min(wide, tall) ? 2 ** (wide + tall - 1) : 0),
    width = 1 << shift,
    height = Math.ceil(size / width);
  const data = new Float32Array(4 * width * height);
  let tops = new Float32Array(rows * columns);
  for (let j = 0, n = 0; j < rows; j++)
    for (let i = 0; i < columns; i++, n++) {
      const a = z(i, j),
        right = z(i + 1, j),
        up = z(i, j + 1),
        across = z(i + 1, j + 1);
      data.set([a, right - a, up - a, across - right - up + a], 4 * n);
      tops[n] = Math.max(a, right, up, across);
    }
  let [w, h] = [columns, rows];
  for (let level = 1; level <= Math.min(wide, tall); level++) {
    const start = rows * columns + 2 ** (wide + tall - 2 * level),
      stride = 2 ** (wide - level);
    const [nextW, nextH] = [Math.ceil(w / 2), Math.ceil(h / 2)],
      next = new Float32Array(nextW * nextH);
    for (let j = 0; j < nextH; j++)
      for (let i = 0; i < nextW; i++) {
        const [i1, j1] = [Math.min(2 * i + 1, w - 1), Math.min(2 * j + 1, h - 1)];
        const top = Math.max(
          tops[2 * j * w + 2 * i],
          tops[2 * j * w + i1],
          tops[j1 * w + 2 * i],
          tops[j1 * w + i1],
        );
        next[j * nextW + i] = top;
        data[4 * (start + j * stride + i)] = top;
      }
    [tops, w, h] = [next, nextW, nextH];
  }
  return { width, height, data };
}
