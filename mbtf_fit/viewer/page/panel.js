// The panel.

// What a reference picture fixes.
const FIXED = [
  "shape",
  "tiles",
  "zoom",
  "add_light",
  "remove_light",
  "color",
  "environment",
  "environment_intensity",
  "environment_angle",
];

const tilesText = (tiles) => {
  const number = Number(tiles.toPrecision(2));
  return `${number} ${number === 1 ? "tile" : "tiles"}`;
};

function bindPanel(viewer) {
  const { state, content, renderer } = viewer,
    canvas = renderer.canvas;
  const refreshers = [],
    refresh = () => refreshers.forEach((update) => update());
  viewer.refresh = refresh;

  const option = (select, value, text) => select.add(new Option(text, value));
  // An input; `text` writes its value beside a slider.
  const bind = (id, get, set, text) => {
    const input = byId(id),
      output = input.parentElement.querySelector("output");
    refreshers.push(() => {
      input.value = get();
      if (output) output.textContent = text();
    });
    input.addEventListener("input", () => {
      if (input.disabled) return;
      set(input.type === "range" ? Number(input.value) : input.value);
      refresh();
    });
  };
  const light = () => state.lights[viewer.chosen] ?? { color: [1, 1, 1], intensity: 0 };
  const hex = (color) =>
    `#${color
      .map((c) =>
        Math.round(clamp(255 * encoded(c), 0, 255))
          .toString(16)
          .padStart(2, "0"),
      )
      .join("")}`;
  const stops = (x) => Math.log2(Math.max(x, 1e-3));

  for (const name of NAMES.shape) if (name) option(byId("shape"), name, name);
  for (const name of NAMES.name) if (name) option(byId("environment"), name, name);
  option(byId("against"), "none", "nothing");
  viewer.materials.forEach((material, k) => {
    option(byId("material"), k, material.name);
    option(byId("against"), `material ${k}`, material.name);
  });
  viewer.pictures.forEach((picture, k) => option(byId("against"), `picture ${k}`, picture.name));
  byId("material").parentElement.hidden = viewer.materials.length < 2;
  byId("against_label").hidden = viewer.materials.length < 2 && !viewer.pictures.length;

  bind(
    "shape",
    () => state.shape,
    (x) => {
      state.shape = x;
      viewer.shapeChanged();
      viewer.frameShape();
    },
  );
  bind(
    "tiles",
    () => Math.log2(state.tiles),
    (x) => {
      // The shape keeps its size in the picture.
      const { camera } = viewer,
        factor = 2 ** x / state.tiles;
      state.tiles = 2 ** x;
      camera.target = scaled(camera.target, factor);
      camera.zoom(factor);
      viewer.shapeChanged();
    },
    () => Number(state.tiles.toPrecision(2)),
  );
  bind(
    "zoom",
    () => -Math.log2(viewer.camera.tiles_across),
    (x) => {
      viewer.camera.tiles_across = clamp(2 ** -x, ...NEAR_AND_FAR);
      viewer.changed();
    },
    () => tilesText(viewer.camera.tiles_across),
  );
  bind(
    "intensity",
    () => stops(light().intensity),
    (x) => {
      light().intensity = 2 ** x;
      viewer.picture ? viewer.againstChanged() : viewer.changed();
    },
    () => light().intensity.toPrecision(2),
  );
  bind(
    "color",
    () => hex(light().color),
    (x) => {
      light().color = [1, 3, 5].map((k) => decoded(parseInt(x.slice(k, k + 2), 16) / 255));
      viewer.changed();
    },
  );
  bind(
    "environment",
    () => state.environment.name,
    (x) => {
      state.environment.name = x;
      viewer.environmentChanged();
    },
  );
  bind(
    "environment_intensity",
    () => stops(state.environment.intensity),
    (x) => {
      state.environment.intensity = 2 ** x;
      viewer.changed();
    },
    () => state.environment.intensity.toPrecision(2),
  );
  bind(
    "environment_angle",
    () => state.environment.angle,
    (x) => {
      state.environment.angle = x;
      viewer.changed();
    },
    () => `${Math.round(state.environment.angle)}°`,
  );
  bind(
    "exposure",
    () => state.exposure ?? 0,
    (x) => {
      state.exposure = x;
      viewer.redraw();
      viewer.saveLater();
    },
    () => `${(state.exposure ?? 0).toFixed(2)} EV`,
  );
  bind(
    "material",
    () => state.material,
    (x) => {
      state.material = Number(x);
      viewer.changed();
    },
  );
  bind(
    "against",
    () => state.against,
    (x) => {
      state.against = x;
      viewer.againstChanged();
    },
  );
  refreshers.push(() => drawDome(byId("dome"), state.lights, viewer.chosen));
  refreshers.push(() => {
    const other = viewer.picture?.name ?? viewer.shown[1]?.name,
      { length } = state.lights;
    for (const id of ["divider", "left_name", "right_name"]) byId(id).hidden = !other;
    byId("tiles_label").hidden = state.shape === "plane";
    byId("left_name").textContent = viewer.material.name;
    byId("right_name").textContent = other ?? "";
    byId("name").textContent = viewer.material.name;
    byId("fixed").hidden = !viewer.picture;
    byId("dark").hidden = length > 0 || renderer.lit;
    const { model, facts } = viewer.material.content;
    byId("facts").replaceChildren(
      ...Object.entries({ model, ...facts })
        .filter(([, value]) => value !== null && value !== undefined)
        .map(([key, value]) => {
          const row = document.createElement("tr");
          row.insertCell().textContent = key;
          row.insertCell().textContent =
            typeof value === "number" ? value.toLocaleString("en", { maximumFractionDigits: 1 }) : value;
          return row;
        }),
    );
    // A reference picture fixes view, shape and light, except for the light's intensity.
    for (const id of FIXED) byId(id).disabled = Boolean(viewer.picture);
    byId("intensity").disabled = !length;
    for (const id of ["color", "remove_light"]) byId(id).disabled ||= !length;
    byId("add_light").disabled ||= length >= MOST_LIGHTS;
  });

  byId("add_light").addEventListener("click", () => {
    viewer.stopLight();
    state.lights.push({
      direction: fromAngles(40, 45 + 90 * state.lights.length),
      color: [1, 1, 1],
      intensity: 1.5,
    });
    viewer.chosen = state.lights.length - 1;
    viewer.changed();
    refresh();
  });
  byId("remove_light").addEventListener("click", () => {
    viewer.stopLight();
    state.lights.splice(viewer.chosen, 1);
    viewer.chosen = Math.max(0, viewer.chosen - 1);
    viewer.changed();
    refresh();
  });
  byId("automatic").addEventListener("click", () => {
    state.exposure = null;
    viewer.redraw();
    viewer.saveLater();
  });
  byId("reset").addEventListener("click", () => viewer.restore(""));
  byId("link").addEventListener("click", async () => {
    history.replaceState(null, "", linkOf(state, viewer.camera));
    try {
      await navigator.clipboard.writeText(location.href);
      byId("link").textContent = "copied";
    } catch {
      byId("link").textContent = "see address";
    }
    setTimeout(() => (byId("link").textContent = "copy link"), 2000);
  });
  byId("save").addEventListener("click", () => {
    viewer.redraw();
    canvas.toBlob((blob) => {
      const anchor = document.createElement("a");
      anchor.href = URL.createObjectURL(blob);
      anchor.download = `${viewer.material.name}.png`;
      anchor.click();
      setTimeout(() => URL.revokeObjectURL(anchor.href), 1000);
    });
  });
  bindDome(viewer);
  bindDivider(viewer);
  bindCanvas(viewer);
  new ResizeObserver(() => viewer.layout()).observe(canvas.parentElement);
  refresh();
}

// Values over all lights and views at a place of the picture, of the material that is shown there.
function showPoint(viewer, x, y) {
  const material = (x > viewer.state.divide && viewer.shown[1]) || viewer.material,
    found = viewer.renderer.pick(material, viewer.scene, x, y);
  byId("plots").hidden = !found;
  if (!found) {
    byId("point").textContent = "There is no material at this place.";
    return;
  }
  const light = viewer.state.lights[viewer.chosen]?.direction ?? [0, 0, 1];
  const least = material.content.min_cos,
    towards = normalized([light[0], light[1], Math.max(light[2], least)]);
  const over = (id, omega, over_views, mark) => {
    const values = viewer.renderer.overDirections(material, 128, found, omega, over_views);
    return drawValues(byId(id), 128, values, mark);
  };
  const largest = over("over_lights", found.omega_o, false, towards);
  over("over_views", towards, true, found.omega_o);
  const finest = material.content.finest,
    level = clamp(-Math.log2(2 * found.sigma), 0, finest);
  byId("point").textContent =
    `${material.name} at u = (${found.u.map((c) => c.toFixed(4)).join(", ")}), footprint σ = ${Number((found.sigma * 2 ** finest).toPrecision(2))} texels (level ${level.toFixed(1)} of ${finest}), largest value ${largest.toPrecision(3)} 1/sr`;
}
