// The panel and the mouse.

function bindPanel(viewer) {
  const { state, content, renderer } = viewer,
    canvas = renderer.canvas;
  const refreshers = [],
    refresh = () => refreshers.forEach((update) => update());
  viewer.refresh = refresh;

  const option = (select, value, text) => select.add(new Option(text, value));
  const bind = (id, get, set) => {
    const input = byId(id);
    refreshers.push(() => (input.value = get()));
    input.addEventListener("input", () => {
      set(input.type === "range" ? Number(input.value) : input.value);
      refresh();
    });
  };
  const light = () => state.lights[viewer.chosen] ?? { color: [1, 1, 1], intensity: 1, direction: [0, 0, 1] };
  const hex = (color) =>
    `#${color
      .map((c) =>
        Math.round(clamp(encoded(c), 0, 255))
          .toString(16)
          .padStart(2, "0"),
      )
      .join("")}`;
  const linear = (x) => (x <= 0.04045 ? x / 12.92 : Math.pow((x + 0.055) / 1.055, 2.4));

  for (const name of Object.keys(SHAPES)) option(byId("shape"), name, name);
  if (content.mesh) option(byId("shape"), content.mesh.name, content.mesh.name);
  for (const name of [
    "none",
    ...Object.keys(BUILT_IN),
    ...(content.environment ? [content.environment.name] : []),
  ])
    option(byId("environment"), name, name);
  // What can be shown and compared; more comes while fits are trained.
  viewer.choicesChanged = () => {
    for (const id of ["material", "against"]) byId(id).replaceChildren();
    option(byId("against"), "none", "nothing");
    viewer.materials.forEach((material, k) => {
      option(byId("material"), k, material.name);
      option(byId("against"), `material ${k}`, material.name);
    });
    viewer.pictures.forEach((picture, k) => option(byId("against"), `picture ${k}`, picture.name));
    byId("material").parentElement.hidden = viewer.materials.length < 2;
    byId("against_label").hidden = viewer.materials.length < 2 && !viewer.pictures.length;
    refresh();
  };

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
      state.tiles = 2 ** x;
      viewer.shapeChanged();
    },
  );
  bind(
    "zoom",
    () => Math.log2(viewer.camera.tiles_across),
    (x) => {
      viewer.camera.tiles_across = 2 ** x;
      viewer.changed();
    },
  );
  bind(
    "intensity",
    () => Math.log2(light().intensity || 1e-3),
    (x) => {
      light().intensity = 2 ** x;
      viewer.picture ? viewer.againstChanged() : viewer.changed();
    },
  );
  bind(
    "color",
    () => hex(light().color),
    (x) => {
      light().color = [1, 3, 5].map((k) => linear(parseInt(x.slice(k, k + 2), 16) / 255));
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
    () => Math.log2(state.environment.intensity),
    (x) => {
      state.environment.intensity = 2 ** x;
      viewer.changed();
    },
  );
  bind(
    "environment_angle",
    () => state.environment.angle,
    (x) => {
      state.environment.angle = x;
      viewer.changed();
    },
  );
  bind(
    "exposure",
    () => state.exposure,
    (x) => {
      state.exposure = x;
      viewer.redraw();
      viewer.saveLater();
    },
  );
  bind(
    "material",
    () => state.material,
    (x) => {
      state.material = Number(x);
      viewer.shapeChanged();
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
    const other = viewer.picture?.name ?? (viewer.shown[1] && viewer.shown[1].name);
    for (const id of ["divider", "left_name", "right_name"]) byId(id).hidden = !other;
    byId("tiles_label").hidden = state.shape === "plane";
    byId("left_name").textContent = viewer.material.name;
    byId("right_name").textContent = other ?? "";
    byId("name").textContent = viewer.material.name;
    byId("model").textContent = viewer.material.content.model;
    byId("facts").replaceChildren(
      ...Object.entries(viewer.material.content.facts)
        .filter(([, value]) => value !== null && value !== undefined)
        .map(([key, value]) => {
          const row = document.createElement("tr");
          row.insertCell().textContent = key;
          row.insertCell().textContent =
            typeof value === "number" ? value.toLocaleString("en", { maximumFractionDigits: 1 }) : value;
          return row;
        }),
    );
  });

  byId("add_light").addEventListener("click", () => {
    if (state.lights.length >= 4) return;
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
    state.lights.splice(viewer.chosen, 1);
    viewer.chosen = Math.max(0, viewer.chosen - 1);
    viewer.changed();
    refresh();
  });
  byId("reset").addEventListener("click", () => {
    Object.assign(state, stateOf("", new Camera()));
    Object.assign(viewer.camera, new Camera());
    viewer.chosen = 0;
    viewer.shapeChanged();
    viewer.environmentChanged();
    viewer.againstChanged();
    refresh();
  });
  byId("link").addEventListener("click", async () => {
    history.replaceState(null, "", linkOf(state, viewer.camera));
    try {
      await navigator.clipboard.writeText(location.href);
      byId("link").textContent = "copied";
    } catch {
      byId("link").textContent = "in the address bar";
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

  // Dragging: what a pointer does until it is released.
  const drag = (element, begin) => {
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      const move = begin(event),
        at = { x: event.clientX, y: event.clientY };
      const moved = (next) => {
        move(next, next.clientX - at.x, next.clientY - at.y);
        Object.assign(at, { x: next.clientX, y: next.clientY });
        refresh();
      };
      element.addEventListener("pointermove", moved);
      const end = () => element.removeEventListener("pointermove", moved);
      for (const name of ["pointerup", "pointercancel"]) element.addEventListener(name, end, { once: true });
    });
  };
  drag(byId("dome"), (event) => {
    const at = domeDirection(byId("dome"), event);
    const near = state.lights.map(({ direction }) => Math.hypot(direction[0] - at[0], direction[1] - at[1]));
    viewer.chosen = Math.max(0, near.indexOf(Math.min(...near)));
    const move = (next) => {
      if (!state.lights.length || viewer.picture) return;
      light().direction = domeDirection(byId("dome"), next);
      viewer.changed();
    };
    move(event);
    refresh();
    return move;
  });
  drag(byId("divider"), () => (next) => {
    const box = canvas.getBoundingClientRect();
    state.divide = clamp((next.clientX - box.left) / box.width, 0.02, 0.98);
    viewer.layout();
  });
  drag(canvas, (event) => {
    const box = canvas.getBoundingClientRect();
    let far = 0;
    canvas.addEventListener(
      "pointerup",
      (last) => {
        if (far < 4 && event.button === 0 && !event.shiftKey)
          showPoint(viewer, (last.clientX - box.left) / box.width, (last.clientY - box.top) / box.height);
      },
      { once: true },
    );
    return (next, dx, dy) => {
      far += Math.abs(dx) + Math.abs(dy);
      if (viewer.picture) return;
      if (event.shiftKey && state.lights.length) {
        const [elevation, azimuth] = toAngles(light().direction);
        light().direction = fromAngles(
          clamp(elevation - (90 * dy) / box.height, 1, 89.9),
          azimuth + (180 * dx) / box.width,
        );
      } else if (event.button === 2 || event.ctrlKey) viewer.camera.pan(dx / box.width, -dy / box.width);
      else
        viewer.camera.orbit(
          (180 * dx) / box.width,
          (120 * dy) / box.height,
          state.shape === "plane" ? 2 : -85,
        );
      viewer.changed();
    };
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      if (viewer.picture) return;
      viewer.camera.zoom(2 ** (clamp(event.deltaY, -200, 200) / 400));
      viewer.changed();
      refresh();
    },
    { passive: false },
  );
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5] }[event.key];
    if (viewer.picture) return;
    if (step) viewer.camera.orbit(...step, state.shape === "plane" ? 2 : -85);
    else if (event.key === "+") viewer.camera.zoom(0.8);
    else if (event.key === "-") viewer.camera.zoom(1.25);
    else return;
    event.preventDefault();
    viewer.changed();
    refresh();
  });
  new ResizeObserver(() => viewer.layout()).observe(canvas.parentElement);
  viewer.choicesChanged();
}

// Values over all lights and views at a place of the picture.
function showPoint(viewer, x, y) {
  const found = viewer.renderer.pick(viewer.material, viewer.scene, x, y);
  byId("plots").hidden = !found;
  if (!found) {
    byId("point").textContent = "There is no material at this place.";
    return;
  }
  const light = viewer.state.lights[viewer.chosen]?.direction ?? [0, 0, 1];
  const least = viewer.material.content.min_cos,
    towards = normalized([light[0], light[1], Math.max(light[2], least)]);
  const over = (id, omega, over_views, mark) => {
    const values = viewer.renderer.overDirections(viewer.material, 128, found, omega, over_views);
    return drawValues(byId(id), 128, values, mark);
  };
  const largest = over("over_lights", found.omega_o, false, towards);
  over("over_views", towards, true, found.omega_o);
  const level = clamp(-Math.log2(2 * found.sigma), 0, viewer.material.content.finest);
  byId("point").textContent =
    `u = (${found.u.map((c) => c.toFixed(4)).join(", ")}), footprint σ = ${found.sigma.toPrecision(2)} tiles (level ${level.toFixed(1)}), largest value ${largest.toPrecision(3)} 1/sr`;
}
