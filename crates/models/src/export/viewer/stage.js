// The stage: the camera as it is, and the picture that it sees.

// The camera is still this long after its last move, in milliseconds.
const STILL_AFTER = 150;
// The longest time between two pictures of a moving camera.
const FRAME = 33;
// How fast fog comes once the camera leaves a photograph, a second; and where it ends, relative to what is looked at.
const FOG_RATE = 2.5, FOG_DEPTH = 0.12;
// How much darker the picture is at the limit of where the camera may go.
const LIMIT_SHADE = 0.75;

// The share to draw after a picture took `milliseconds`.
function adapted(share, milliseconds) {
  const next = milliseconds > 1.2 * FRAME ? share * Math.max(0.5, FRAME / milliseconds) : share * 1.1;
  return clamp(next, 0.05, 1);
}

// The factors on red, green and blue that the sliders ask for. Warmer is redder, at the same brightness.
function look(edge) {
  const [stops, warmth] = ['brightness', 'warmth'].map((id) => Number(element(id).value));
  const gain = 2 ** stops * (1 - LIMIT_SHADE * edge);
  return [gain * 2 ** warmth, gain * 2 ** (-0.1 * warmth), gain * 2 ** (-1.4 * warmth)];
}

// `state` has what moves: the pose, the target that it turns about, the lens, the view that it is (null: free).
function makeStage(gl) {
  const views = scene.views, poses = views.map(pose), home = center(poses);
  const { load, restrict, draw, sumsAt, layers } = renderer(gl, () => refresh());
  // The automatic path stays where the cameras are.
  const flown = scene.path.map((viewFromWorld) => pose({ viewFromWorld }));
  const region = photographedRegion([...scene.cameras.map(pose), ...flown], home);
  const state = { current: { ...poses[0] }, target: home, lens: views[0], bookmark: 0, last: 0 };
  // The share of the Gaussians that is drawn while the camera moves: as many as the device draws in time.
  let fraction = 1, moved = -Infinity, painted = 0, pending = false, fog = 0, isCoarse = false;
  const movers = [], painters = [];
  const reach = () => Math.max(distance(state.target, state.current.eye), 2 * scene.near);
  const isShared = () => root.dataset.face === 'share';
  // Where photographs were taken is known from several of them, and where they lie is what one wants to see of poses.
  const isLimited = () => isShared() && !scene.showsCameras && scene.cameras.length > 1;

  // A free camera fills the canvas with the view's angle, and has square pixels.
  const freed = () => {
    const { clientWidth: w, clientHeight: h } = canvas, { lens } = state, { zoom } = placed(lens, w, h);
    const focal = [lens.focal[1] * zoom, lens.focal[1] * zoom];
    return { size: [w, h], focal, principalPoint: [w / 2, h / 2], viewFromWorld: matrix(state.current) };
  };
  const camera = () => (state.bookmark === null ? freed() : views[state.bookmark]);
  const refresh = () => {
    if (pending) return;
    pending = true;
    root.dataset.settled = 'false';
    requestAnimationFrame(paint);
  };
  const hasMoved = () => { moved = performance.now(); refresh(); };

  // Moves what moves by itself.
  const advance = (seconds) => {
    for (const mover of [...movers]) {
      if (mover(seconds)) hasMoved(); else movers.splice(movers.indexOf(mover), 1);
    }
    const wanted = state.bookmark === null && isLimited() ? 1 : 0;
    if (fog === wanted) return;
    fog = wanted ? Math.min(1, fog + FOG_RATE * seconds) : 0;
    hasMoved();
  };
  const paint = () => {
    pending = false;
    const now = performance.now(), wasMoving = now - moved < STILL_AFTER;
    advance(wasMoving ? Math.min(0.1, (now - painted) / 1000) : 0.016);
    const isMoving = performance.now() - moved < STILL_AFTER;
    if (isMoving && now - painted < 10 * STILL_AFTER) fraction = adapted(fraction, now - painted);
    painted = now;
    // A device that draws few in time draws fewer pixels, too.
    isCoarse = isMoving && (isCoarse || fraction < 0.5);
    const ratio = (window.devicePixelRatio || 1) * (isCoarse ? 0.5 : 1);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((v) => Math.max(1, Math.round(v * ratio)));
    // Before grey, what black hides is seen: holes.
    const grey = element('grey').checked ? 0.5 : 0, layer = isShared() ? 0 : Number(element('layer').value);
    const edge = isLimited() && state.bookmark === null ? region.edge(state.current.eye) : 0;
    const isWhole = draw(camera(), width, height, {
      grey, layer, share: isMoving ? fraction : 1, reach: reach(), lamp: element('lamp').checked ? scene.lamp : null,
      fog: [fog, FOG_DEPTH * reach()], look: isShared() ? look(edge) : PLAIN,
    });
    root.dataset.settled = String(isWhole && !isMoving);
    if (isMoving) setTimeout(refresh, STILL_AFTER);
    for (const painter of painters) painter();
  };

  // Calls `mover` with the seconds since the last picture until it returns false.
  const animate = (mover) => {
    if (!movers.includes(mover)) movers.push(mover);
    hasMoved();
  };
  const rest = () => { movers.length = 0; };
  // Leaves the view, if the camera is at one.
  const free = () => { if (state.bookmark !== null) stage.choose(null); };
  // Flies to a pose, then calls `done`.
  const flyTo = (to, seconds, done = () => {}) => {
    free();
    rest();
    const from = { ...state.current };
    let time = prefersStill() ? seconds : 0;
    animate((passed) => {
      time += passed;
      state.current = time < seconds ? between(from, to, smooth(time / seconds)) : { ...to };
      if (time >= seconds) done();
      return time < seconds;
    });
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
    if (!sumsAt) return null;
    const ratio = canvas.width / canvas.clientWidth, { camera: own, fit } = fitted();
    draw(own, canvas.width, canvas.height, { grey: 0, layer: 1, share: 1, reach: reach() });
    const [sum, , , alpha] = sumsAt(...[x, y].map((v) => Math.floor(v * ratio)));
    refresh();
    if (!(alpha > 0.3)) return null;
    const depth = sum / alpha, { right, down, forward, eye } = pose(own);
    const slope = [x - fit.left, y - fit.top].map((v, k) => (v / fit.zoom - own.principalPoint[k]) / own.focal[k]);
    return add(add(add(eye, forward, depth), right, depth * slope[0]), down, depth * slope[1]);
  };
  const keyframe = () => {
    const own = camera(), { eye, ...axes } = pose(own), fov = 2 * Math.atan(own.size[1] / (2 * own.focal[1]));
    return { position: add(eye, scene.origin), rotation: quaternion(axes), fov: fov * 180 / Math.PI };
  };
  const stage = {
    views, poses, home, flown, region, state, layers, load, restrict, sumsAt, reach, refresh, hasMoved, animate, rest,
    free, flyTo, projected, pointAt, keyframe, isLimited, painters, choose: () => {},
  };
  return stage;
}
