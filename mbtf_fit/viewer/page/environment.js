// Light from all around: samples of a picture of the whole sphere, seen from inside. Rows are latitudes, the
// top one at z; columns go to the right, which is clockwise from above: column i of n is at azimuth
// 90° - 360° (i + ½) / n.

const SAMPLES = 4096;

// Radiance of a softbox studio or of a sky, at unit vectors.
const BUILT_IN = {
  studio: ([x, y, z]) => {
    const box = (dx, dy, dz, width) => Math.exp(-Math.pow(Math.hypot(x - dx, y - dy, z - dz) / width, 8));
    const key = 5 * box(0.5, -0.55, 0.67, 0.45),
      fill = 1.6 * box(-0.8, -0.1, 0.6, 0.4),
      rim = 3 * box(-0.1, 0.85, 0.5, 0.3);
    return [
      0.15 + key + 0.9 * fill + rim,
      0.15 + 0.96 * key + 0.95 * fill + rim,
      0.16 + 0.9 * key + 1.05 * fill + 1.05 * rim,
    ];
  },
  sky: ([x, y, z]) => {
    const up = Math.max(z, 0),
      sun = 60 * Math.exp(250 * (dot([x, y, z], [0.48, -0.36, 0.8]) - 1));
    const below = z < 0 ? 0.35 : 1;
    return [
      below * (0.35 + 0.25 * (1 - up)) + sun,
      below * (0.5 + 0.25 * (1 - up)) + 0.92 * sun,
      below * (0.85 + 0.1 * (1 - up)) + 0.8 * sun,
    ];
  },
};

// Azimuth of a share of a picture's width.
const azimuthOf = (share) => Math.PI * (0.5 - 2 * share);

// Table of samples {width, height, data}: their density follows luminance; mean irradiance of a horizontal
// plane is that of a directional light of irradiance 1 from above.
function environmentSamples(rows, columns, radianceAt) {
  const values = [],
    cumulative = [];
  let total = 0,
    irradiance = 0;
  for (let j = 0; j < rows; j++)
    for (let i = 0; i < columns; i++) {
      const theta = (Math.PI * (j + 0.5)) / rows,
        phi = azimuthOf((i + 0.5) / columns);
      const solid = (((Math.PI / rows) * (2 * Math.PI)) / columns) * Math.sin(theta);
      const rgb = radianceAt(j, i, [
        Math.sin(theta) * Math.cos(phi),
        Math.sin(theta) * Math.sin(phi),
        Math.cos(theta),
      ]);
      const luminance = 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];
      total += luminance * solid;
      irradiance += luminance * solid * Math.max(Math.cos(theta), 0);
      values.push({ rgb, luminance });
      cumulative.push(total);
    }
  const data = new Float32Array(4 * 2 * SAMPLES);
  // A fixed generator, so that the page is the same each time.
  let seed = 1;
  const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
  for (let s = 0, k = 0; s < SAMPLES; s++) {
    const at = ((s + random()) / SAMPLES) * total;
    while (k < cumulative.length - 1 && cumulative[k] < at) k++;
    const theta = (Math.PI * (Math.floor(k / columns) + random())) / rows,
      phi = azimuthOf(((k % columns) + random()) / columns);
    const { rgb, luminance } = values[k],
      weight = luminance > 0 ? total / luminance / (irradiance || 1) : 0;
    // Rows of pairs: 64 directions, then their radiances.
    const row = 2 * Math.floor(s / 64),
      column = s % 64;
    data.set(
      [Math.sin(theta) * Math.cos(phi), Math.sin(theta) * Math.sin(phi), Math.cos(theta)],
      4 * (64 * row + column),
    );
    data.set(scaled(rgb, weight), 4 * (64 * (row + 1) + column));
  }
  return { width: 64, height: (2 * SAMPLES) / 64, data };
}

function environmentOf(name, user) {
  if (name === user?.name) {
    const rgb = floatsOf(user.data),
      [rows, columns] = user.shape;
    return environmentSamples(rows, columns, (j, i) =>
      [0, 1, 2].map((c) => Math.max(0, rgb[3 * (j * columns + i) + c])),
    );
  }
  return environmentSamples(32, 64, (j, i, w) => BUILT_IN[name](w));
}
