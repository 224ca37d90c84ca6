// Vectors as arrays of three numbers, 4 × 4 matrices by columns; the sRGB curve.

const add = (a, b) => a.map((x, k) => x + b[k]);
const scaled = (a, s) => a.map((x) => x * s);
const dot = (a, b) => a.reduce((sum, x, k) => sum + x * b[k], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const normalized = (a) => scaled(a, 1 / Math.hypot(...a));
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const radians = (degrees) => (degrees * Math.PI) / 180;

// Unit vector at an elevation and azimuth in degrees, z up.
function fromAngles(elevation, azimuth) {
  const [e, a] = [radians(elevation), radians(azimuth)];
  return [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
}

// Elevation and azimuth in degrees.
function toAngles([x, y, z]) {
  return [(Math.asin(clamp(z, -1, 1)) * 180) / Math.PI, (Math.atan2(y, x) * 180) / Math.PI];
}

// The sRGB curve, from linear values in [0, 1], and its inverse.
const encoded = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * Math.pow(x, 1 / 2.4) - 0.055);
const decoded = (x) => (x <= 0.04045 ? x / 12.92 : Math.pow((x + 0.055) / 1.055, 2.4));

function product(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}
