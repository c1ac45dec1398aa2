// The cameras of the photographs, drawn in space with names and photographs: one sees where poses are wrong.

// Names of more cameras than this are shown under the cursor only.
const MOST_NAMES = 60;
// The width of the photograph of the camera under the cursor, in CSS pixels.
const PREVIEW = 260;
const CHOSEN = '#ffd54a', OTHER = '#6cf';
// How near to a camera's eye the cursor chooses it, in CSS pixels.
const CHOSEN_WITHIN = 18;

// The brightness that makes a dark photograph seen.
function visible(image) {
  const small = Object.assign(document.createElement('canvas'), { width: 16, height: 16 });
  const context = small.getContext('2d', { willReadFrequently: true });
  context.drawImage(image, 0, 0, 16, 16);
  const { data } = context.getImageData(0, 0, 16, 16);
  const mean = data.reduce((sum, v, k) => sum + (k % 4 < 3 ? v : 0), 0) / 768;
  return clamp(100 / Math.max(mean, 1), 1, 16);
}

function showCameras(stage) {
  const { state, views, poses } = stage, over = element('frusta'), context = over.getContext('2d');
  // Frusta are as long as a part of the usual distance between a camera and its nearest neighbour.
  const to = ({ eye }) => poses.map((other) => distance(eye, other.eye) || Infinity);
  const apart = poses.map((own) => Math.min(...to(own)));
  const usual = apart.filter(Number.isFinite).sort((a, b) => a - b)[apart.length >> 1] ?? stage.reach() / 4;
  const length = clamp(0.6 * usual, 0.06 * stage.reach(), 0.25 * stage.reach());
  const corners = views.map(({ size, focal, principalPoint }, k) => [[0, 0], [1, 0], [1, 1], [0, 1]].map((corner) => {
    const [x, y] = corner.map((v, axis) => (v * size[axis] - principalPoint[axis]) / focal[axis] * length);
    return add(add(add(poses[k].eye, poses[k].forward, length), poses[k].right, x), poses[k].down, y);
  }));
  const pictures = new Map();
  let hovered = null;
  const isShown = () => element('cameras').checked && root.dataset.face === 'inspect';

  // The photograph of a camera, loaded when it is wanted.
  const picture = (k) => {
    const [first] = views[k].pictures;
    if (!first) return null;
    if (!pictures.has(k)) {
      const image = new Image();
      pictures.set(k, { image, isLoaded: false });
      image.onload = () => {
        pictures.set(k, { image, isLoaded: true, filter: `brightness(${visible(image)})` });
        draw();
      };
      image.src = first.image;
    }
    return pictures.get(k);
  };
  const line = (points) => {
    context.beginPath();
    points.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
  };
  // The photograph lies in its frustum's image plane; three corners place it.
  const paste = (k, [a, b, , d]) => {
    const own = picture(k);
    if (!own?.isLoaded) return;
    const { naturalWidth: w, naturalHeight: h } = own.image;
    context.save();
    context.transform((b[0] - a[0]) / w, (b[1] - a[1]) / w, (d[0] - a[0]) / h, (d[1] - a[1]) / h, a[0], a[1]);
    context.filter = own.filter;
    context.drawImage(own.image, 0, 0);
    context.restore();
  };
  // That of the camera under the cursor is large enough to be recognized.
  const preview = () => {
    const own = hovered === null ? null : picture(hovered);
    if (!own?.isLoaded) return;
    const height = PREVIEW * own.image.naturalHeight / own.image.naturalWidth, top = canvas.clientHeight - height - 16;
    context.filter = own.filter;
    context.drawImage(own.image, 16, top, PREVIEW, height);
    context.filter = 'none';
    context.lineWidth = 2;
    context.strokeStyle = CHOSEN;
    context.strokeRect(16, top, PREVIEW, height);
  };
  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    [over.width, over.height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
    over.hidden = !isShown();
    if (over.hidden) return;
    context.scale(ratio, ratio);
    context.font = '12px system-ui, sans-serif';
    const eyes = poses.map(({ eye }) => stage.projected(eye));
    const farFirst = eyes.map((_, k) => k).sort((a, b) => (a === hovered) - (b === hovered) || eyes[b][2] - eyes[a][2]);
    for (const k of farFirst) {
      const plane = corners[k].map(stage.projected);
      if (k === state.bookmark || [eyes[k], ...plane].some(([, , depth]) => !(depth > scene.near))) continue;
      const isChosen = k === hovered;
      if (isChosen || views.length <= MOST_NAMES) paste(k, plane);
      context.strokeStyle = isChosen ? CHOSEN : OTHER;
      context.lineWidth = isChosen ? 2.5 : 1.2;
      line([...plane, plane[0]]);
      for (const corner of plane) line([eyes[k], corner]);
      if (!isChosen && views.length > MOST_NAMES) continue;
      context.lineWidth = 3;
      context.strokeStyle = '#000a';
      context.fillStyle = isChosen ? CHOSEN : '#fff';
      context.strokeText(views[k].name, eyes[k][0] + 6, eyes[k][1] - 6);
      context.fillText(views[k].name, eyes[k][0] + 6, eyes[k][1] - 6);
    }
    preview();
  };
  const under = (event) => {
    const at = onCanvas(event), apart = poses.map(({ eye }, k) => {
      const [x, y, depth] = stage.projected(eye);
      return depth > scene.near && k !== state.bookmark ? Math.hypot(x - at[0], y - at[1]) : Infinity;
    });
    const nearest = Math.min(...apart);
    return nearest < CHOSEN_WITHIN ? apart.indexOf(nearest) : null;
  };
  let pressed = null;
  canvas.addEventListener('pointermove', (event) => {
    if (!isShown() || event.buttons) return;
    const found = under(event);
    if (found !== hovered) { hovered = found; canvas.style.cursor = found === null ? '' : 'pointer'; draw(); }
  });
  canvas.addEventListener('pointerdown', (event) => {
    pressed = isShown() ? { at: onCanvas(event), view: under(event) } : null;
  });
  // A click on a camera goes there.
  canvas.addEventListener('pointerup', (event) => {
    if (pressed?.view == null || distance(onCanvas(event), pressed.at) > 4 || element('tool').value) return;
    const view = pressed.view;
    stage.flyTo(poses[view], 0.6, () => stage.choose(view));
  });
  stage.painters.push(draw);
}
