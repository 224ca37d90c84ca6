(() => {
  const $ = id => document.getElementById(id);
  const data = JSON.parse($('data').textContent);
  const { bits, low, step } = data.coding;
  const state = { group: 0, scene: 0, fit: 0, kind: 0, map: 'local', stops: 0, at: 0.5 };

  // Decodes base64 and inflates.
  const inflate = async text => {
    const raw = Uint8Array.from(atob(text), c => c.charCodeAt(0));
    const stream = new Blob([raw]).stream().pipeThrough(new DecompressionStream('deflate'));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };

  // Codes of an image, three per pixel; each image is decoded once.
  const decoded = new Map();
  const codes = name => {
    if (!decoded.has(name)) decoded.set(name, decode(data.pictures[name]));
    return decoded.get(name);
  };
  const decode = async ({ rows, columns, data: text }) => {
    const bytes = await inflate(text);
    const n = rows * columns;
    const channel = index => {
      const out = new Int32Array(n), start = 2 * index * n;
      for (let i = 0, y = 0; y < rows; y++) {
        for (let x = 0; x < columns; x++, i++) {
          const folded = bytes[start + i] | (bytes[start + n + i] << 8);
          const rest = folded & 1 ? -((folded + 1) >> 1) : folded >> 1;
          out[i] = rest + (((x ? out[i - 1] : 0) + (y ? out[i - columns] : 0)) >> 1);
        }
      }
      return out;
    };
    const [g, r, b] = [channel(0), channel(1), channel(2)];
    const out = new Uint16Array(3 * n);
    for (let i = 0; i < n; i++) {
      out[3 * i] = r[i] + g[i];
      out[3 * i + 1] = g[i];
      out[3 * i + 2] = b[i] + g[i];
    }
    return { rows, columns, codes: out };
  };

  const linear = code => code ? low * 2 ** ((code - 1) * step) : 0;
  // A table from code to 8-bit sRGB at the selected exposure.
  const brightness = () => {
    const factor = 2 ** (data.exposure + state.stops);
    return Uint8ClampedArray.from({ length: 1 << bits }, (_, code) => {
      const x = Math.min(1, factor * linear(code));
      return Math.round(255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055));
    });
  };

  const draw = (canvas, picture, color) => {
    const { rows, columns } = picture;
    if (canvas.width !== columns || canvas.height !== rows) Object.assign(canvas, { width: columns, height: rows });
    const context = canvas.getContext('2d');
    const image = context.createImageData(columns, rows);
    color(image.data);
    context.putImageData(image, 0, 0);
  };
  const drawLinear = (canvas, picture) => draw(canvas, picture, out => {
    const from = picture.codes, shown = brightness();
    for (let i = 0, j = 0; i < from.length; i += 3, j += 4) {
      out[j] = shown[from[i]];
      out[j + 1] = shown[from[i + 1]];
      out[j + 2] = shown[from[i + 2]];
      out[j + 3] = 255;
    }
  });
  const values = Float64Array.from({ length: 1 << bits }, (_, code) => linear(code));
  const drawDifference = (canvas, fit, reference) => draw(canvas, fit, out => {
    const { scale, colors } = data.difference;
    for (let i = 0, j = 0; i < fit.codes.length; i += 3, j += 4) {
      let sum = 0;
      for (let c = 0; c < 3; c++) sum += values[fit.codes[i + c]] - values[reference.codes[i + c]];
      const t = Math.max(-1, Math.min(1, sum / 3 / scale));
      const color = colors[Math.round(127.5 * (t + 1))];
      for (let c = 0; c < 3; c++) out[j + c] = color[c];
      out[j + 3] = 255;
    }
  });

  const signed = (x, digits) => (x < 0 ? '−' : '+') + Math.abs(x).toFixed(digits);
  const exposureText = () => {
    const exposure = data.exposure + state.stops;
    return `exposure ${signed(exposure, 2)} EV (${Number((2 ** -exposure).toPrecision(3))} 1/sr is white)`;
  };
  const stage = $('stage');

  const place = at => {
    state.at = Math.max(0, Math.min(1, at));
    const share = `${(100 * state.at).toFixed(2)}%`;
    $('fit').style.clipPath = `inset(0 0 0 ${share})`;
    $('border').style.left = share;
    const [left, right] = [stage.querySelector('.left'), stage.querySelector('.right')];
    left.style.opacity = state.at < 0.12 ? 0 : 1;
    right.style.opacity = state.at > 0.88 ? 0 : 1;
    stage.setAttribute('aria-valuenow', Math.round(100 * state.at));
    stage.setAttribute('aria-valuetext', `${Math.round(100 * state.at)} % reference, the rest ${data.fits[state.fit]}`);
  };

  const current = () => data.scenes[state.scene];
  let call = 0;
  // Draws the current selection; a later call cancels an earlier one in progress.
  const show = async () => {
    const own = ++call;
    const scene = current(), side = scene.references[state.kind];
    const [reference, fit, main] = await Promise.all([side.picture, scene.fits[state.fit], scene.references[0].picture].map(codes));
    if (own !== call) return;
    drawLinear($('reference'), reference);
    drawLinear($('fit'), fit);
    const name = data.fits[state.fit];
    stage.querySelector('.left').textContent = side.label;
    stage.querySelector('.right').textContent = name;
    place(state.at);
    $('caption').textContent = `${scene.where}. Left: ${side.label.toLowerCase()} (path-traced); right: ${name}; ${exposureText()}.`;
    const chart = $(`${scene.fits[state.fit]}-${state.map}`);
    $('map-image').hidden = !chart;
    $('map-canvas').hidden = !!chart;
    const title = { local: 'Local RMS error', flip: 'HDR-FLIP', signed: 'Fit − reference' }[state.map];
    if (chart) $('map-image').src = chart.src;
    else drawDifference($('map-canvas'), fit, main);
    for (const element of [$('map-image'), $('map-canvas')]) {
      element.setAttribute(chart ? 'alt' : 'aria-label', `${title} of ${name}: ${scene.where}`);
    }
    document.querySelectorAll('#maps .color-bar').forEach(bar => { bar.hidden = bar.dataset.map !== state.map; });
    numbers(side.rows);
    stage.dataset.drawn = [state.scene, state.kind, state.fit, state.stops].join(' ');
  };

  const numbers = rows => {
    const body = $('numbers');
    const cell = (tag, text, chosen) => Object.assign(document.createElement(tag), { textContent: text, className: chosen ? 'chosen' : '' });
    const line = (tag, texts) => {
      const row = document.createElement('tr');
      texts.forEach((text, i) => row.append(cell(tag, text, i === state.fit + 1 && data.fits.length > 1)));
      return row;
    };
    body.replaceChildren(line('th', ['', ...data.fits]), ...rows.map(row => line('td', row)));
  };

  // Replaces the images of the sheet by canvases that follow the exposure.
  const sheet = [];
  const redrawSheet = () => sheet.forEach(([canvas, picture]) => drawLinear(canvas, picture));
  const activateSheet = async () => {
    for (const img of document.querySelectorAll('img[data-linear]')) {
      const picture = await codes(img.dataset.linear);
      const canvas = document.createElement('canvas');
      canvas.className = 'picture';
      canvas.setAttribute('role', 'img');
      canvas.setAttribute('aria-label', img.alt);
      canvas.dataset.caption = img.alt;
      drawLinear(canvas, picture);
      sheet.push([canvas, picture]);
      img.replaceWith(canvas);
    }
    document.querySelectorAll('.at-exposure').forEach(e => { e.hidden = false; });
    document.body.dataset.sheet = 'drawn';
  };

  let waiting = 0;
  const expose = stops => {
    state.stops = stops;
    $('stops').value = stops;
    $('stops').setAttribute('aria-valuetext', exposureText());
    document.querySelectorAll('.exposure-text').forEach(e => { e.textContent = exposureText(); });
    show();
    clearTimeout(waiting);
    waiting = setTimeout(() => { redrawSheet(); document.body.dataset.exposure = state.stops; }, 60);
  };

  // Fields of view of the selected view and light.
  const widths = () => {
    const of = data.scenes.map((scene, i) => [scene, i]).filter(([scene]) => scene.group === state.group);
    const wanted = current().tiles_across;
    const chosen = of.find(([scene]) => scene.tiles_across === wanted) || of[0];
    state.scene = chosen[1];
    $('tiles-across').replaceChildren(...of.map(([scene, i]) => {
      const label = document.createElement('label');
      const input = Object.assign(document.createElement('input'), { type: 'radio', name: 'scene', value: i, checked: i === state.scene });
      const text = Object.assign(document.createElement('span'), { textContent: scene.tiles_across });
      label.append(input, text);
      return label;
    }));
  };
  const choose = scene => {
    state.scene = scene;
    state.group = current().group;
    document.querySelectorAll('input[name=group]').forEach(e => { e.checked = Number(e.value) === state.group; });
    widths();
    show();
  };

  $('viewer').addEventListener('change', ({ target }) => {
    if (target.name === 'scene') choose(Number(target.value));
    else if (target.name === 'group') { state.group = Number(target.value); widths(); show(); }
    else if (target.name === 'map') { state.map = target.value; show(); }
    else if (target.name === 'fit' || target.name === 'kind') { state[target.name] = Number(target.value); show(); }
  });
  $('stops').addEventListener('input', event => expose(Number(event.target.value)));
  $('zero').addEventListener('click', () => expose(0));

  const follow = event => {
    const { left, width } = stage.getBoundingClientRect();
    place((event.clientX - left) / width);
  };
  stage.addEventListener('pointerdown', event => {
    if (event.button) return;
    stage.setPointerCapture(event.pointerId);
    follow(event);
  });
  stage.addEventListener('pointermove', event => { if (stage.hasPointerCapture(event.pointerId)) follow(event); });
  stage.addEventListener('keydown', event => {
    const by = { ArrowLeft: -0.01, ArrowDown: -0.01, ArrowRight: 0.01, ArrowUp: 0.01, PageDown: -0.1, PageUp: 0.1 }[event.key];
    if (by) place(state.at + (event.shiftKey ? 10 : 1) * by);
    else if (event.key === 'Home') place(0);
    else if (event.key === 'End') place(1);
    else return;
    event.preventDefault();
  });

  // Images of the sheet open in the viewer, other images in a dialog.
  const dialog = $('large');
  const enlarge = picture => {
    const [img, caption] = [dialog.querySelector('img'), dialog.querySelector('p')];
    img.src = picture.src;
    img.alt = caption.textContent = picture.alt;
    dialog.showModal();
  };
  document.addEventListener('click', event => {
    const button = event.target.closest('button.zoom');
    if (!button) return;
    if (!button.dataset.scene) return enlarge(button.querySelector('img'));
    const { fit, kind, map } = button.dataset;
    for (const [name, value] of Object.entries({ fit, kind, map })) {
      if (value === undefined) continue;
      state[name] = name === 'map' ? value : Number(value);
      document.querySelectorAll(`input[name=${name}]`).forEach(e => { e.checked = e.value === value; });
    }
    choose(Number(button.dataset.scene));
    $('viewer').scrollIntoView();
    stage.focus({ preventScroll: true });
  });
  dialog.addEventListener('click', () => dialog.close());

  // Expands all details for printing.
  addEventListener('beforeprint', () => document.querySelectorAll('details').forEach(e => { e.open = true; }));

  const start = async () => {
    $('viewer').hidden = false;
    widths();
    expose(0);
    await show();
    await activateSheet();
  };
  start().catch(error => {
    $('viewer').hidden = true;
    $('too-old').hidden = false;
    throw error;
  });
})();
