// The page: its two faces, its controls and keys, and how it opens.

// A shared page hides its bar after so many seconds without a hand on it, in full screen and in the automatic flight.
const IDLE_AFTER = 3000;  // milliseconds
const HINTS = {
  fine: 'Drag to turn · scroll to come nearer · W A S D to fly · double-click sets the centre',
  coarse: 'One finger turns · two fingers move and come nearer · double-tap sets the centre',
};

// The picture alone, with its bar; or with a panel beside it, in which the model is as it was trained.
function faces(stage) {
  const show = (face) => {
    root.dataset.face = face;
    fills = face === 'share';
    element('panel').hidden = fills;
    element('bar').hidden = element('caption').hidden = !fills;
    stage.refresh();
  };
  const asked = /\b(share|inspect)\b/.exec(location.hash);
  show(asked ? asked[1] : scene.isLive ? 'inspect' : 'share');
  return () => show(fills ? 'inspect' : 'share');
}

// How to move, for as long as it takes to read; and a bar that goes while nothing is touched.
function hints() {
  const hint = element('hint');
  hint.textContent = matchMedia('(pointer: coarse)').matches ? HINTS.coarse : HINTS.fine;
  hint.dataset.shown = 'true';
  setTimeout(() => { hint.dataset.shown = 'false'; }, IDLE_AFTER);
  let timer = 0;
  const awake = () => {
    clearTimeout(timer);
    root.dataset.idle = 'false';
    timer = setTimeout(() => {
      const isBusy = Boolean(element('bar').querySelector(':focus-visible'));
      root.dataset.idle = String(!isBusy && (root.dataset.playing === 'true' || Boolean(document.fullscreenElement)));
    }, IDLE_AFTER);
  };
  for (const kind of ['pointermove', 'pointerdown', 'keydown', 'focusin']) document.addEventListener(kind, awake);
}

// Puts views, layers and facts into the page.
function fill(stage) {
  element('views').append(new Option('free', ''), ...stage.views.map(({ name }, k) => new Option(name, String(k))));
  stage.layers.forEach((name, k) => element('layer').add(new Option(name, String(k))));
  element('lamp').parentElement.hidden = !scene.lamp;
  element('cameras').checked = Boolean(scene.showsCameras);
  element('provenance').append(...scene.provenance.map((line) => {
    const item = document.createElement('li');
    item.textContent = line;
    return item;
  }));
}

// Keys, wherever the focus is. A control keeps the keys that change it: arrows, Home, Enter and the like.
function keyboard(keys, commands) {
  const isTaken = ({ target, key }) => {
    const isValue = target.id === 'divider' || target.tagName === 'SELECT' || target.type === 'range';
    if (isValue) return key.length > 1 && key !== 'Escape';
    return ['Enter', ' '].includes(key) && ['INPUT', 'BUTTON', 'SUMMARY'].includes(target.tagName);
  };
  document.addEventListener('keydown', (event) => {
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey || event.altKey || isTaken(event) || element('info').open) return;
    if (keys.knows(key)) keys.press(key, event.shiftKey);
    else if (commands[key]) { if (!event.repeat) commands[key](); } else return;
    event.preventDefault();
  });
  document.addEventListener('keyup', ({ key }) => keys.release(key.toLowerCase()));
  // Shift changes the letter of a key that is held, and a window that is left hears of no release.
  for (const kind of ['blur', 'visibilitychange']) window.addEventListener(kind, keys.stop);
  // What was set with the mouse gives the keys back to the picture.
  let isPointer = false;
  document.addEventListener('pointerdown', () => { isPointer = true; }, true);
  document.addEventListener('keydown', ({ key }) => {
    isPointer = false;
    if (key === 'Tab') root.dataset.tabbed = 'true';
  }, true);
  const giveBack = () => { if (isPointer && !element('info').open) canvas.focus({ preventScroll: true }); };
  document.addEventListener('change', giveBack);
  document.addEventListener('click', (event) => { if (event.target.closest('button')) giveBack(); });
  document.addEventListener('pointerup', ({ target }) => {
    if (target.matches?.('#divider, [type=range]')) giveBack();
  });
}

function start(gl) {
  const stage = makeStage(gl), { state, views, poses } = stage, moves = makeMoves(stage);
  const edit = editor({ target: () => state.target, ...stage }, stage.restrict);
  const compare = comparison(stage), play = player(stage), keys = flight(stage, moves), toggleFace = faces(stage);
  const asked = /\bview=(\d+)/.exec(location.hash);
  stage.choose = (index) => {
    state.bookmark = index;
    if (index !== null) {
      stage.rest();
      [state.last, state.current, state.lens] = [index, { ...poses[index] }, views[index]];
    }
    element('return').disabled = index !== null;
    element('views').value = index === null ? '' : String(index);
    compare.list();
    stage.refresh();
  };
  const back = () => { play.stop(); state.target = stage.home; stage.choose(state.last); };
  // As the page opens: the photograph, which is dark, over the left half of the model.
  const reset = () => {
    compare.middle();
    for (const id of ['grey', 'lamp', 'difference']) element(id).checked = false;
    for (const id of ['layer', 'brightness', 'warmth']) {
      element(id).value = linked(id);
      element(id).dispatchEvent(new Event('input'));
    }
    state.last = asked && views[asked[1]] ? Number(asked[1]) : 0;
    back();
    if (scene.showsCameras) {
      stage.choose(null);
      [state.current, state.target] = overview(poses, stage.home);
    } else if (views[state.last].pictures.length) element('compare').value = '0';
    canvas.focus({ preventScroll: true });
  };
  const fillScreen = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else root.requestFullscreen?.().catch(() => {});
  };
  const click = (id) => () => element(id).click();
  const actions = {
    return: back, reset, fullscreen: fillScreen, play: play.toggle, before: () => { play.stop(); compare.toggle(); },
    about: () => element('info').showModal(), closeInfo: () => element('info').close(),
    inspect: () => { element('info').close(); toggleFace(); }, closePanel: toggleFace,
  };
  for (const [id, act] of Object.entries(actions)) element(id).addEventListener('click', act);
  keyboard({ ...keys, press: (key, fast) => { play.stop(); keys.press(key, fast); } }, {
    g: click('grey'), l: click('lamp'), r: back, f: fillScreen, home: reset, p: play.toggle, ' ': play.toggle,
    b: actions.before, i: toggleFace, '?': actions.about,
  });
  pointing(stage, moves, edit, play.stop);
  showCameras(stage);
  countUnder(stage);
  fill(stage);
  element('views').addEventListener('change', ({ target: { value } }) => {
    play.stop();
    stage.choose(value === '' ? null : Number(value));
  });
  element('panel').addEventListener('change', stage.refresh);
  sliders(stage);
  new ResizeObserver(stage.refresh).observe(canvas);
  reset();
  // Shows another model; the camera stays.
  return (buffer) => {
    element('count').textContent = `${stage.load(buffer)} Gaussians`;
    edit.load(buffer);
    stage.refresh();
  };
}

// The value of a slider in the address, which a link carries; 0: as trained.
function linked(id) {
  return new RegExp(`\\b${id}=(-?[\\d.]+)`).exec(location.hash)?.[1] ?? '0';
}

// Puts the sliders into the address.
function link() {
  const kept = location.hash.slice(1).split('&').filter((part) => part && !/^(brightness|warmth)=/.test(part));
  const set = ['brightness', 'warmth'].filter((id) => Number(element(id).value));
  const parts = [...kept, ...set.map((id) => `${id}=${element(id).value}`)].join('&');
  // Without anything, the fragment goes as well.
  history.replaceState(null, '', parts ? `#${parts}` : location.href.replace(/#.*$/, ''));
}

// Brightness in stops, and the colour of white; in the middle, the model as it was trained.
function sliders(stage) {
  const inWords = {
    brightness: (value) => `${value > 0 ? '+' : '−'}${Math.abs(value).toFixed(1)} stops`,
    warmth: (value) => `${Math.round(Math.abs(value) / 0.006)} % ${value > 0 ? 'warmer' : 'cooler'}`,
  };
  for (const [id, words] of Object.entries(inWords)) {
    const slider = element(id);
    slider.addEventListener('input', () => {
      const text = Number(slider.value) ? words(Number(slider.value)) : 'as trained';
      slider.setAttribute('aria-valuetext', text);
      slider.title = `${slider.ariaLabel}: ${text}`;
      stage.refresh();
    });
    slider.addEventListener('change', link);
    slider.addEventListener('dblclick', () => {
      slider.value = 0;
      for (const kind of ['input', 'change']) slider.dispatchEvent(new Event(kind));
    });
  }
}

// With the number of Gaussians of every pixel shown, says that under the cursor.
function countUnder(stage) {
  canvas.addEventListener('pointermove', (event) => {
    if (event.buttons || Number(element('layer').value) !== COUNT_LAYER) return;
    const ratio = canvas.width / canvas.clientWidth;
    const [found] = stage.sumsAt(...onCanvas(event).map((v) => Math.floor(v * ratio)));
    say(`${found} Gaussians under the cursor`);
  });
}

async function open() {
  const gl = canvas.getContext('webgl2', { antialias: false, preserveDrawingBuffer: true });
  const lacks = 'this browser has no WebGL 2; turn hardware acceleration on, or open model.ply in another viewer';
  if (!gl) throw new Error(lacks);
  const show = start(gl);
  if (scene.isLive) await follow(show);
  else show(await unpack());
  say('');
  hints();
  root.dataset.ready = 'true';
}
open().catch((error) => {
  say(`The model cannot be shown: ${error.message}`);
  root.dataset.ready = 'failed';
});
