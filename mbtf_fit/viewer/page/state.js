// What the user has chosen, and the link that restores it.

const FIRST = {
  camera: {},
  shape: "plane",
  tiles: 4,
  lights: [{ direction: fromAngles(45, -30), color: [1, 1, 1], intensity: 3 }],
  environment: { name: "none", intensity: 1, angle: 0 },
  exposure: 0,
  divide: 0.5,
  material: 0,
  against: "none",
};

const rounded = (x) => (typeof x === "number" ? Math.round(x * 1e4) / 1e4 : x);

function linkOf(state, camera) {
  const { elevation, azimuth, tiles_across, target } = camera;
  const text = JSON.stringify({ ...state, camera: { elevation, azimuth, tiles_across, target } }, (_, x) =>
    rounded(x),
  );
  return `#${encodeURIComponent(text)}`;
}

// A copy of `known` with the values of `given` that have its type and, of numbers, are finite.
function merged(known, given) {
  if (Array.isArray(known)) {
    if (!Array.isArray(given)) return known;
    return known.length && typeof known[0] === "object"
      ? given.slice(0, 4).map((x) => merged(known[0], x))
      : given.length === known.length
        ? given.map((x, k) => merged(known[k], x))
        : known;
  }
  if (known && typeof known === "object")
    return given && typeof given === "object"
      ? Object.fromEntries(Object.keys(known).map((k) => [k, merged(known[k], given[k])]))
      : known;
  return typeof given === typeof known && (typeof given !== "number" || Number.isFinite(given))
    ? given
    : known;
}

// State of a link's fragment; the first state where it is damaged.
function stateOf(fragment, camera) {
  const known = {
    ...structuredClone(FIRST),
    camera: {
      elevation: camera.elevation,
      azimuth: camera.azimuth,
      tiles_across: camera.tiles_across,
      target: camera.target,
    },
  };
  try {
    return merged(known, JSON.parse(decodeURIComponent(fragment.slice(1))));
  } catch {
    return merged(known, {});
  }
}
