(() => {
  const $ = id => document.getElementById(id);
  const data = JSON.parse($('data').textContent);
  const state = { group: 0, scene: 0, fit: 0, kind: 0, map: 'local', at: 0.5 };
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
  // Shows the current selection; its images are those of the sheet, but for the signed difference.
  const show = () => {
    const scene = current(), side = scene.references[state.kind], file = scene.fits[state.fit];
    const name = data.fits[state.fit];
    for (const [where, source] of [['reference', side.picture], ['fit', file]]) {
      Object.assign($(where), { src: $(source).src, alt: $(source).alt });
    }
    stage.querySelector('.left').textContent = side.label;
    stage.querySelector('.right').textContent = name;
    place(state.at);
    $('caption').textContent = `${scene.where}. Left: ${side.label.toLowerCase()} (path-traced); right: ${name}.`;
    const title = { local: 'Local RMS error', flip: 'HDR-FLIP', signed: 'Fit − reference' }[state.map];
    $('map-image').src = state.map === 'signed' ? data.differences[`${file}-signed`] : $(`${file}-${state.map}`).src;
    $('map-image').alt = `${title} of ${name}: ${scene.where}`;
    document.querySelectorAll('#maps .color-bar').forEach(bar => { bar.hidden = bar.dataset.map !== state.map; });
    numbers(side.rows);
    stage.dataset.drawn = [state.scene, state.kind, state.fit].join(' ');
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

  $('viewer').hidden = false;
  widths();
  show();
})();
