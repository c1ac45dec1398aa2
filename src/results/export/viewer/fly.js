// Moves the camera, and shows the model with pictures to compare.

const add = (a, b, s = 1) => a.map((v, k) => v + s * b[k]);
const dot = (a, b) => a.reduce((sum, v, k) => sum + v * b[k], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const rotate = (v, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(v, axis) * (1 - c), side = cross(axis, v);
  return v.map((value, k) => value * c + side[k] * s + axis[k] * along);
};

// Right, down and forward in the world, and the eye.
function pose(view) {
  const m = view.viewFromWorld, row = (k) => [m[k], m[3 + k], m[6 + k]];
  const [right, down, forward] = [row(0), row(1), row(2)];
  const eye = [0, 1, 2].map((k) => -(right[k] * m[9] + down[k] * m[10] + forward[k] * m[11]));
  return { right, down, forward, eye };
}

function matrix({ right, down, forward, eye }) {
  const columns = [0, 1, 2].flatMap((k) => [right[k], down[k], forward[k]]);
  return [...columns, -dot(right, eye), -dot(down, eye), -dot(forward, eye)];
}

// The rotation (w, x, y, z) that maps the axes of the camera to the world.
function quaternion({ right, down, forward }) {
  const diagonal = [right[0], down[1], forward[2]];
  const largest = [1 + diagonal[0] + diagonal[1] + diagonal[2], ...diagonal.map((v, k) => 1 + 2 * v - diagonal[0] - diagonal[1] - diagonal[2])];
  const [wx, wy, wz] = [down[2] - forward[1], forward[0] - right[2], right[1] - down[0]];
  const [xy, xz, yz] = [down[0] + right[1], forward[0] + right[2], forward[1] + down[2]];
  const rows = [[largest[0], wx, wy, wz], [wx, largest[1], xy, xz], [wy, xy, largest[2], yz], [wz, xz, yz, largest[3]]];
  // The row with the largest element divides by no small number.
  const row = rows[largest.indexOf(Math.max(...largest))], length = Math.hypot(...row);
  return row.map((v) => v / length);
}

// The point nearest to all optical axes.
function center(poses) {
  const a = [0, 0, 0, 0, 0, 0, 0, 0, 0], b = [0, 0, 0];
  for (const { forward, eye } of poses) {
    for (let i = 0; i < 3; i++) {
      for (let j = 0; j < 3; j++) {
        const entry = (i === j ? 1 : 0) - forward[i] * forward[j];
        a[3 * i + j] += entry;
        b[i] += entry * eye[j];
      }
    }
  }
  const column = (k) => [a[k], a[3 + k], a[6 + k]];
  const determinant = dot(column(0), cross(column(1), column(2)));
  const first = poses[0];
  return Math.abs(determinant) < 1e-9 * poses.length ** 3
    ? add(first.eye, first.forward, 10 * scene.near)
    : [dot(b, cross(column(1), column(2))), dot(column(0), cross(b, column(2))), dot(column(0), cross(column(1), b))]
      .map((value) => value / determinant);
}

// The camera is still this long after its last move, in milliseconds.
const STILL_AFTER = 150;
// The longest time between two pictures of a moving camera.
const FRAME = 33;

// The share to draw after a picture took `milliseconds`.
function adapted(share, milliseconds) {
  const next = milliseconds > 1.2 * FRAME ? share * Math.max(0.5, FRAME / milliseconds) : share * 1.1;
  return Math.min(1, Math.max(0.05, next));
}

function start(gl) {
  const views = scene.views, poses = views.map(pose);
  const { load, restrict, draw, sumsAt, layers } = renderer(gl, () => refresh());
  const down = scene.up.map((value) => -value);
  let current = { ...poses[0] }, bookmark = 0, lens = views[0], target = center(poses), pending = false;
  // How much of the view its picture covers, the view's left edge and width on the page, and the last bookmark.
  let share = 0.5, across = [0, 1], last = 0;
  // The share of the Gaussians that is drawn while the camera moves: as many as the device draws in time.
  let fraction = 1, moved = -Infinity, painted = 0;
  const asked = /^#view=(\d+)$/.exec(location.hash);
  const reach = () => Math.max(Math.hypot(...add(target, current.eye, -1)), 2 * scene.near);

  const camera = () => (bookmark === null ? freed() : views[bookmark]);
  // A free camera fills the canvas with the view's angle, and has square pixels.
  const freed = () => {
    const { clientWidth: w, clientHeight: h } = canvas, s = Math.min(w / lens.size[0], h / lens.size[1]);
    return { size: [w, h], focal: [lens.focal[1] * s, lens.focal[1] * s], principalPoint: [w / 2, h / 2], viewFromWorld: matrix(current) };
  };
  const paint = () => {
    pending = false;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
    const now = performance.now(), isMoving = now - moved < STILL_AFTER;
    if (isMoving && now - painted < STILL_AFTER) fraction = adapted(fraction, now - painted);
    painted = now;
    // Before grey, what black hides is seen: holes.
    const grey = element('grey').checked ? 0.5 : 0, layer = Number(element('layer').value);
    const lamp = element('lamp').checked ? scene.lamp : null;
    const isWhole = draw(camera(), width, height, { grey, layer, share: isMoving ? fraction : 1, reach: reach(), lamp });
    document.documentElement.dataset.settled = String(isWhole);
    if (isMoving) setTimeout(refresh, STILL_AFTER);
    compare(ratio);
  };
  const refresh = () => { if (!pending) { pending = true; requestAnimationFrame(paint); } };

  // The picture of the view lies over the left part of the model.
  const compare = () => {
    const picture = bookmark === null ? null : views[bookmark].pictures[element('compare').value];
    element('overlay').hidden = element('divider').hidden = !picture;
    if (!picture) return;
    const fit = placed(views[bookmark], canvas.clientWidth, canvas.clientHeight);
    const [width, height] = views[bookmark].size.map((v) => v * fit.zoom);
    across = [fit.left, width];
    Object.assign(element('overlay').style,
      { left: fit.left + 'px', top: fit.top + 'px', width: share * width + 'px', height: height + 'px' });
    Object.assign(element('divider').style,
      { left: fit.left + share * width + 'px', top: fit.top + 'px', height: height + 'px' });
    element('divider').setAttribute('aria-valuenow', Math.round(100 * share));
    const image = element('picture');
    if (image.getAttribute('src') !== picture.image) image.src = picture.image;
    image.classList.toggle('difference', element('difference').checked);
    Object.assign(image.style, { width: width + 'px', height: height + 'px' });
    element('leftText').textContent = picture.label;
  };
  const choose = (index) => {
    bookmark = index;
    if (index !== null) last = index;
    element('return').disabled = index !== null;
    element('views').value = index === null ? '' : String(index);
    const before = element('compare').value, list = element('compare');
    list.replaceChildren(new Option('model alone', ''));
    if (index !== null) {
      current = { ...poses[index] };
      lens = views[index];
      views[index].pictures.forEach(({ label }, k) => list.add(new Option(label, String(k))));
      list.value = views[index].pictures[before] ? before : '';
    }
    refresh();
  };
  const free = () => {
    moved = performance.now();
    if (bookmark !== null) choose(null);
  };
  const back = () => { target = center(poses); choose(last); };
  // As the page opens: the photograph, which is dark, over the left half of the model.
  const reset = () => {
    share = 0.5;
    element('grey').checked = element('lamp').checked = false;
    element('layer').value = '0';
    last = asked && views[asked[1]] ? Number(asked[1]) : 0;
    back();
    if (views[last].pictures.length) element('compare').value = '0';
    canvas.focus({ preventScroll: true });
  };
  const divide = (value) => { share = Math.max(0, Math.min(1, value)); compare(); };
  const fill = () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  };

  // Dragging turns about the target, upright; moving takes the target along.
  const turn = (x, y) => {
    free();
    const about = (axis, angle) => {
      const arm = rotate(add(current.eye, target, -1), axis, angle);
      current.eye = add(target, arm);
      for (const key of ['right', 'down', 'forward']) current[key] = rotate(current[key], axis, angle);
    };
    about(down, x);
    const level = dot(current.forward, down);
    if (!(level > 0.98 && y > 0) && !(level < -0.98 && y < 0)) about(current.right, y);
    refresh();
  };
  const look = (x, y) => {
    free();
    for (const [axis, angle] of [[down, x], [current.right, y]]) {
      for (const key of ['right', 'down', 'forward']) current[key] = rotate(current[key], axis, angle);
    }
    target = add(current.eye, current.forward, reach());
    refresh();
  };
  const move = (x, y, z) => {
    free();
    const step = [0, 1, 2].map((k) => x * current.right[k] + y * current.down[k] + z * current.forward[k]);
    current.eye = add(current.eye, step);
    target = add(target, step);
    refresh();
  };
  const approach = (factor) => {
    free();
    current.eye = add(target, add(current.eye, target, -1), factor);
    refresh();
  };

  // With the number of Gaussians of every pixel shown, says that under the cursor.
  const countAt = ({ clientX, clientY }) => {
    if (Number(element('layer').value) !== COUNT_LAYER) return;
    const box = canvas.getBoundingClientRect(), ratio = canvas.width / box.width;
    const [found] = sumsAt(...[clientX - box.left, clientY - box.top].map((v) => Math.floor(v * ratio)));
    say(`${found} Gaussians under the cursor`);
  };
  // What the tools of the editor ask for; places on the page are in CSS pixels from the canvas's top left.
  const fitted = () => ({ camera: camera(), fit: placed(camera(), canvas.clientWidth, canvas.clientHeight) });
  const projected = (point) => {
    const { camera: { viewFromWorld: m, focal, principalPoint }, fit } = fitted();
    const [x, y, z] = [0, 1, 2].map((k) => m[k] * point[0] + m[3 + k] * point[1] + m[6 + k] * point[2] + m[9 + k]);
    const on = (value, k) => fit.zoom * (focal[k] * value / z + principalPoint[k]) + [fit.left, fit.top][k];
    return [on(x, 0), on(y, 1), z];
  };
  const pointAt = (x, y) => {
    const ratio = canvas.width / canvas.clientWidth, { camera: own, fit } = fitted();
    draw(own, canvas.width, canvas.height, { grey: 0, layer: 1, share: 1, reach: reach() });
    const [sum, , , alpha] = sumsAt(...[x, y].map((v) => Math.floor(v * ratio)));
    refresh();
    if (!(alpha > 0.3)) return null;
    const depth = sum / alpha, { right, down: own_down, forward, eye } = pose(own);
    const slope = [x - fit.left, y - fit.top].map((v, k) => (v / fit.zoom - own.principalPoint[k]) / own.focal[k]);
    return add(add(add(eye, forward, depth), right, depth * slope[0]), own_down, depth * slope[1]);
  };
  const keyframe = () => {
    const own = camera(), { eye, ...axes } = pose(own), fov = 2 * Math.atan(own.size[1] / (2 * own.focal[1]));
    return { position: add(eye, scene.origin), rotation: quaternion(axes), fov: fov * 180 / Math.PI };
  };
  const edit = editor({ target: () => target, reach, projected, pointAt, keyframe }, restrict);
  const onCanvas = ({ clientX, clientY }) => {
    const box = canvas.getBoundingClientRect();
    return [clientX - box.left, clientY - box.top];
  };
  const pointers = new Map();
  let spread = 0;
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (edit.begins(...onCanvas(event))) return;
    pointers.set(event.pointerId, event);
    spread = 0;
  });
  for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, (event) => {
    edit.ends();
    pointers.delete(event.pointerId);
  });
  canvas.addEventListener('pointermove', (event) => {
    if (edit.moves(...onCanvas(event))) return;
    const before = pointers.get(event.pointerId);
    if (!before) { countAt(event); return; }
    pointers.set(event.pointerId, event);
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const pixel = reach() / (lens.focal[1] * Math.min(canvas.clientWidth / lens.size[0], canvas.clientHeight / lens.size[1]));
    if (pointers.size > 1) {
      const [a, b] = [...pointers.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (spread) approach(spread / now);
      spread = now;
      move(-x * pixel / 2, -y * pixel / 2, 0);
    } else if (event.buttons & 2 || event.shiftKey) move(-x * pixel, -y * pixel, 0);
    else turn(x * 0.006, -y * 0.006);
  });
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    approach(Math.exp(Math.max(-1, Math.min(1, event.deltaY / 500))));
  }, { passive: false });
  const keys = {
    w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], e: [0, -1, 0], q: [0, 1, 0],
  };
  const commands = { g: 'grey', l: 'lamp', r: 'return', f: 'fullscreen', home: 'reset' };
  // Wherever the focus is, but for controls that have keys of their own.
  document.addEventListener('keydown', (event) => {
    if (event.target.closest?.('select, #divider')) return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = keys[event.key.toLowerCase()], turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (step) move(...step.map((v) => 0.03 * reach() * v));
    else if (turns) look(turns[0] * 0.04, turns[1] * 0.04);
    else if (commands[event.key.toLowerCase()]) element(commands[event.key.toLowerCase()]).click();
    else return;
    event.preventDefault();
  });

  element('views').append(new Option('free', ''), ...views.map(({ name }, k) => new Option(name, String(k))));
  element('views').addEventListener('change', ({ target: { value } }) => choose(value === '' ? null : Number(value)));
  layers.forEach((name, k) => element('layer').add(new Option(name, String(k))));
  element('lamp').parentElement.hidden = !scene.lamp;
  for (const id of ['compare', 'grey', 'layer', 'difference', 'lamp']) element(id).addEventListener('change', refresh);
  for (const [id, act] of [['return', back], ['reset', reset], ['fullscreen', fill]]) element(id).addEventListener('click', act);
  const divider = element('divider');
  divider.addEventListener('pointerdown', (event) => divider.setPointerCapture(event.pointerId));
  divider.addEventListener('pointermove', (event) => {
    if (divider.hasPointerCapture(event.pointerId)) divide((event.clientX - canvas.getBoundingClientRect().left - across[0]) / across[1]);
  });
  divider.addEventListener('keydown', (event) => {
    const to = { ArrowLeft: share - 0.05, ArrowRight: share + 0.05, Home: 0, End: 1 }[event.key];
    if (to === undefined) return;
    divide(to);
    event.preventDefault();
  });
  element('provenance').append(...scene.provenance.map((line) => {
    const item = document.createElement('li');
    item.textContent = line;
    return item;
  }));
  new ResizeObserver(refresh).observe(canvas);
  reset();
  // Shows another model; the camera stays.
  return (buffer) => {
    element('count').textContent = `${load(buffer)} Gaussians`;
    edit.load(buffer);
    refresh();
  };
}

async function open() {
  const gl = canvas.getContext('webgl2', { antialias: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error('this browser has no WebGL 2; turn hardware acceleration on, or open model.ply in another viewer');
  const show = start(gl);
  if (scene.isLive) await follow(show);
  else show(await unpack());
  say('');
  document.documentElement.dataset.ready = 'true';
}
open().catch((error) => {
  say(`The model cannot be shown: ${error.message}`);
  document.documentElement.dataset.ready = 'failed';
});
