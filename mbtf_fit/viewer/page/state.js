// What the user has chosen, and the link that restores it.

const FIRST = {
  camera: { elevation: 50, azimuth: -90, tiles_across: 3, target: [0.5, 0.5, 0] },
  shape: "plane",
  tiles: 4,
  // Irradiance 1 on the plane, where the exposure keeps albedos (mbtf_core/color.py).
  lights: [{ direction: fromAngles(45, -30), color: [1, 1, 1], intensity: Math.SQRT2 }],
  environment: { name: "none", intensity: 1, angle: 0 },
  // In EV; null: from the next picture.
  exposure: 1.65,
  divide: 0.5,
  material: 0,
  against: "none",
};
const MOST_LIGHTS = 4;

// Ranges of numbers, and the names that are known, by key.
const RANGES = {
  elevation: [-85, 90],
  azimuth: [-360, 360],
  tiles_across: NEAR_AND_FAR,
  target: [-1000, 1000],
  tiles: [1, 64],
  direction: [-1, 1],
  color: [0, 1],
  intensity: [0, 16],
  angle: [-180, 180],
  exposure: [-10, 10],
  divide: [0.02, 0.98],
};
const NAMES = {
  shape: [...Object.keys(SHAPES), CONTENT.mesh?.name],
  name: ["none", ...Object.keys(BUILT_IN), CONTENT.environment?.name],
};

const rounded = (x) => (typeof x === "number" ? Math.round(x * 1e4) / 1e4 : x);

function linkOf(state, camera) {
  const { elevation, azimuth, tiles_across, target } = camera;
  const text = JSON.stringify({ ...state, camera: { elevation, azimuth, tiles_across, target } }, (_, x) =>
    rounded(x),
  );
  return `#${encodeURIComponent(text)}`;
}

// A copy of `known` with the values of `given` that have its type; numbers are brought into their range.
function merged(known, given, key) {
  if (Array.isArray(known)) {
    if (!Array.isArray(given)) return known;
    if (typeof known[0] === "object") return given.slice(0, MOST_LIGHTS).map((x) => merged(known[0], x, key));
    if (given.length !== known.length) return known;
    const values = given.map((x, k) => merged(known[k], x, key));
    if (key !== "direction") return values;
    return Math.hypot(...values) > 1e-3 ? normalized(values) : known;
  }
  if (known && typeof known === "object")
    return given && typeof given === "object"
      ? Object.fromEntries(Object.keys(known).map((k) => [k, merged(known[k], given[k], k)]))
      : known;
  if (known === null || typeof known === "number")
    return Number.isFinite(given) ? clamp(given, ...(RANGES[key] ?? [-Infinity, Infinity])) : known;
  return typeof given === typeof known && (NAMES[key]?.includes(given) ?? true) ? given : known;
}

// State of a link's fragment; the first state where it is damaged.
function stateOf(fragment) {
  try {
    return merged(structuredClone(FIRST), JSON.parse(decodeURIComponent(fragment.slice(1))));
  } catch {
    return structuredClone(FIRST);
  }
}
