// Moves the camera: keys, mouse, fingers, and the automatic path.

// Speeds of flight, in distances to what is looked at and in radians a second; Shift is faster.
const FLIGHT = 0.8, TURNING = 0.9, FASTER = 3;
// Seconds in which a flight comes to its speed, and in which what was thrown slows down.
const INERTIA = 0.14, GLIDE = 0.3;
const DRAGGED = 0.006;  // radians a pixel

const prefersStill = () => matchMedia('(prefers-reduced-motion: reduce)').matches;

// Turns, moves and approaches, within the region of the photographs where the camera is limited.
function makeMoves(stage) {
  const { state } = stage, down = scene.up.map((value) => -value);
  const place = (eye) => (stage.isLimited() ? stage.region.limited(state.current.eye, eye) : eye);
  // About the target, upright. At a limit it stops.
  const about = (axis, angle) => {
    const arm = rotate(add(state.current.eye, state.target, -1), axis, angle), eye = add(state.target, arm);
    if (place(eye) !== eye) return;
    state.current.eye = eye;
    for (const key of AXES) state.current[key] = rotate(state.current[key], axis, angle);
  };
  const isSteep = (y) => {
    const level = dot(state.current.forward, down);
    return (level > 0.98 && y < 0) || (level < -0.98 && y > 0);
  };
  const began = () => { stage.free(); stage.hasMoved(); };
  return {
    turn: (x, y) => {
      began();
      about(down, x);
      if (!isSteep(y)) about(state.current.right, y);
    },
    look: (x, y) => {
      began();
      for (const [axis, angle] of [[down, x], [state.current.right, isSteep(y) ? 0 : y]]) {
        for (const key of AXES) state.current[key] = rotate(state.current[key], axis, angle);
      }
      state.target = add(state.current.eye, state.current.forward, stage.reach());
    },
    // Takes the target along.
    move: (x, y, z) => {
      began();
      const { right, down: below, forward, eye } = state.current;
      const to = place(add(add(add(eye, right, x), below, y), forward, z));
      state.target = add(state.target, add(to, eye, -1));
      state.current.eye = to;
    },
    approach: (factor) => {
      began();
      state.current.eye = place(add(state.target, add(state.current.eye, state.target, -1), factor));
    },
  };
}

// Flight by the keys that are held, several at once; it comes to its speed and slows down.
function flight(stage, moves) {
  const directions = {
    w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, -1, 0], q: [0, 1, 0],
    arrowleft: [0, 0, 0, -1, 0], arrowright: [0, 0, 0, 1, 0], arrowup: [0, 0, 0, 0, 1], arrowdown: [0, 0, 0, 0, -1],
  };
  const held = new Set();
  let speed = [0, 0, 0, 0, 0], isFast = false;
  const wanted = () => speed.map((_, k) => [...held].reduce((sum, key) => sum + (directions[key][k] ?? 0), 0)
    * (k < 3 ? FLIGHT * (isFast ? FASTER : 1) : TURNING));
  const fly = (seconds) => {
    const goal = wanted(), share = prefersStill() ? 1 : 1 - Math.exp(-seconds / INERTIA);
    speed = mix(speed, goal, share);
    if (!held.size && Math.hypot(...speed) < 0.01) { speed = speed.map(() => 0); return false; }
    const [x, y, z] = speed.map((v) => v * seconds * stage.reach());
    if (Math.hypot(x, y, z) > 0) moves.move(x, y, z);
    if (speed[3] || speed[4]) moves.look(speed[3] * seconds, speed[4] * seconds);
    return true;
  };
  return {
    knows: (key) => key in directions,
    press: (key, fast) => {
      isFast = fast;
      if (held.has(key)) return;
      held.add(key);
      stage.free();
      // A key that is only tapped moves as well.
      speed = mix(speed, wanted(), 0.3);
      stage.animate(fly);
    },
    release: (key) => held.delete(key),
    stop: () => held.clear(),
  };
}

// The automatic path, round and round, from where the camera is.
function player(stage) {
  const { state, flown: path } = stage;
  const SECONDS = 24, BEGIN = 1.5;
  let along = 0, time = 0, from = null;
  const at = (t) => {
    const first = Math.floor(t) % path.length;
    return between(path[first], path[(first + 1) % path.length], t - Math.floor(t));
  };
  const play = (seconds) => {
    along = (along + seconds / SECONDS * path.length) % path.length;
    time += seconds;
    state.current = between(from, at(along), smooth(time / BEGIN));
    state.target = add(state.current.eye, state.current.forward, stage.playReach);
    return true;
  };
  const show = (isPlaying) => {
    root.dataset.playing = String(isPlaying);
    element('play').setAttribute('aria-pressed', String(isPlaying));
    element('play').setAttribute('aria-label', isPlaying ? 'Pause the flight' : 'Play the automatic flight');
  };
  const stop = () => {
    if (from) stage.rest();
    from = null;
    show(false);
  };
  element('play').hidden = path.length < 2;
  return {
    stop,
    toggle: () => {
      if (from) { stop(); return; }
      stage.free();
      stage.rest();
      const apart = path.map(({ eye }) => distance(eye, state.current.eye));
      stage.playReach = stage.reach();
      [along, time, from] = [apart.indexOf(Math.min(...apart)), 0, { ...state.current }];
      show(true);
      stage.animate(play);
    },
  };
}

// Mouse and fingers on the canvas. `began` is called when one of them takes the camera.
function pointing(stage, moves, edit, began) {
  const { state } = stage, pointers = new Map();
  let spread = 0, thrown = [0, 0], last = 0;
  const zoom = () => placed(state.lens, canvas.clientWidth, canvas.clientHeight).zoom;
  const pixel = () => stage.reach() / (state.lens.focal[1] * zoom());
  const glide = (seconds) => {
    thrown = thrown.map((v) => v * Math.exp(-seconds / GLIDE));
    moves.turn(thrown[0] * seconds, thrown[1] * seconds);
    return Math.hypot(...thrown) > 0.02;
  };
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (edit.begins(...onCanvas(event))) return;
    began();
    stage.rest();
    pointers.set(event.pointerId, event);
    [spread, thrown] = [0, [0, 0]];
  });
  for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, (event) => {
    edit.ends();
    if (!pointers.delete(event.pointerId)) return;
    const isThrown = end === 'pointerup' && event.timeStamp - last < 60 && Math.hypot(...thrown) > 0.2;
    if (isThrown && !prefersStill()) stage.animate(glide);
  });
  canvas.addEventListener('pointermove', (event) => {
    if (edit.moves(...onCanvas(event))) return;
    const before = pointers.get(event.pointerId);
    if (!before) return;
    pointers.set(event.pointerId, event);
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    if (pointers.size > 1) {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (spread) moves.approach(spread / now);
      [spread, thrown] = [now, [0, 0]];
      moves.move(-x * pixel() / 2, -y * pixel() / 2, 0);
    } else if (event.buttons & 2 || event.shiftKey) moves.move(-x * pixel(), -y * pixel(), 0);
    else if (x || y) {
      const seconds = Math.max(0.008, (event.timeStamp - before.timeStamp) / 1000);
      thrown = mix(thrown, [x * DRAGGED / seconds, -y * DRAGGED / seconds], 0.5);
      last = event.timeStamp;
      moves.turn(x * DRAGGED, -y * DRAGGED);
    }
  });
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    began();
    moves.approach(Math.exp(clamp(event.deltaY / 500, -1, 1)));
  }, { passive: false });
  // What is clicked twice becomes the centre.
  canvas.addEventListener('dblclick', (event) => {
    if (element('tool').value) return;
    const point = stage.pointAt(...onCanvas(event));
    if (!point) { say('Nothing is there.'); return; }
    began();
    stage.flyTo(looking(state.current.eye, point), 0.5);
    state.target = point;
  });
}

function onCanvas({ clientX, clientY }) {
  const box = canvas.getBoundingClientRect();
  return [clientX - box.left, clientY - box.top];
}
