// Edits the model. What is done here is a list of operations that `nightsplat edit --edits` applies to the model file.

const EDIT_VERSION = 1;

// Runs of consecutive numbers: [3, [7, 9]].
function spans(sorted) {
  const runs = [];
  for (const index of sorted) {
    const last = runs.at(-1);
    if (last && last[1] === index - 1) last[1] = index; else runs.push([index, index]);
  }
  return runs.map(([first, last]) => (first === last ? first : [first, last]));
}

// Whether a region of a crop contains a point.
function contains({ sphere, box }, point) {
  if (sphere) return Math.hypot(...add(point, sphere[0], -1)) <= sphere[1];
  return point.every((value, k) => value >= box[0][k] && value <= box[1][k]);
}

// The list that `edit` reads. Those that count Gaussians come first, as they are numbered in the file, then those that
// are placed in its world, then those that move the world.
function editList(edits, model) {
  const gone = new Set(edits.flatMap((edit) => edit.delete ?? []));
  const removal = gone.size ? [{ delete: spans([...gone].sort((a, b) => a - b)) }] : [];
  const rest = ['crop', 'up', 'scale'].flatMap((kind) => edits.filter((edit) => edit[kind]));
  return { nightsplat_edits: EDIT_VERSION, model, edits: [...removal, ...rest] };
}

const asJson = (value) => new Blob([JSON.stringify(value, null, 1) + '\n'], { type: 'application/json' });

function download(name, blob) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// The tools. `world` has the camera's pose, a projection to the page, the target and the depth of a pixel; `restrict`
// draws only some of the Gaussians.
function editor(world, restrict) {
  let model = null, edits = [], keyframes = [], clicks = [], stroke = null;
  const tool = () => element('tool').value;
  const number = (id) => Number(element(id).value);
  const position = (i) => [0, 1, 2].map((k) => model.means[3 * i + k] + scene.origin[k]);
  const placed = (point) => add(point, scene.origin);

  // The crop that the sliders describe, around the target.
  const region = () => {
    const center = placed(world.target()), reach = world.reach();
    if (tool() === 'sphere') return { sphere: [center, reach * number('sizeX')] };
    const half = ['sizeX', 'sizeY', 'sizeZ'].map((id) => reach * number(id));
    return { box: [-1, 1].map((side) => center.map((value, k) => value + side * half[k])) };
  };
  const preview = () => {
    if (!model) return;
    const isCrop = ['sphere', 'box'].includes(tool());
    const crops = [...edits.flatMap(({ crop }) => crop ?? []), ...(isCrop ? [region()] : [])];
    const keep = new Uint8Array(model.count).fill(1);
    for (const { delete: gone = [] } of [...edits, ...(stroke ? [stroke] : [])]) for (const i of gone) keep[i] = 0;
    if (crops.length) {
      const isKept = (i) => crops.every((crop) => contains(crop, position(i)));
      for (let i = 0; i < model.count; i++) if (keep[i] && !isKept(i)) keep[i] = 0;
    }
    restrict(keep);
    const kept = keep.reduce((sum, value) => sum + value, 0);
    const names = edits.map((edit) => Object.keys(edit)[0]).join(', ') || 'none';
    element('edits').textContent =
      `${kept} of ${model.count} Gaussians; edits: ${names}; ${keyframes.length} keyframes`;
  };
  const commit = (edit) => { edits.push(edit); clicks = []; preview(); };

  // Removes what is within the brush and nearer than its depth.
  const brush = (x, y) => {
    const radius = number('sizeX') * 100, limit = world.reach() * number('depth') * 2;
    for (let i = 0; i < model.count; i++) {
      const [u, v, depth] = world.projected(model.means.subarray(3 * i, 3 * i + 3));
      if (depth > 0 && depth < limit && Math.hypot(u - x, v - y) < radius) stroke.delete.push(i);
    }
    preview();
  };
  // Two points on the model.
  const click = (x, y) => {
    const point = world.pointAt(x, y);
    if (!point) { say('nothing is there'); return; }
    clicks.push(placed(point));
    say(clicks.length === 1 ? 'now the second point' : '');
    if (clicks.length < 2) return;
    const [from, to] = clicks, line = add(to, from, -1);
    if (tool() === 'up') { commit({ up: line }); return; }
    const length = Number(prompt('The length between the two points', '1'));
    if (length > 0) commit({ scale: { from, to, length } }); else clicks = [];
  };

  const actions = {
    apply: () => {
      if (!['sphere', 'box'].includes(tool())) return;
      const crop = region();
      element('tool').value = '';
      commit({ crop });
    },
    undo: () => { edits.pop(); preview(); },
    keyframe: () => { keyframes.push(world.keyframe()); preview(); },
    saveEdits: () => download('edits.json', asJson(list())),
    savePath: () => download('path.json', asJson(path())),
  };
  for (const [id, act] of Object.entries(actions)) element(id).addEventListener('click', act);
  for (const id of ['tool', 'sizeX', 'sizeY', 'sizeZ']) element(id).addEventListener('input', () => {
    for (const axis of ['sizeY', 'sizeZ']) element(axis).parentElement.hidden = tool() !== 'box';
    element('depth').parentElement.hidden = tool() !== 'brush';
    clicks = [];
    canvas.style.cursor = ['brush', 'up', 'scale'].includes(tool()) ? 'crosshair' : '';
    preview();
  });
  const list = () => editList(edits, scene.model);
  const timed = () => keyframes.map((own, k) => ({ time: 2 * k, ...own }));
  const path = () => ({ nightsplat_path: 1, fps: 30, easing: 'smooth', keyframes: timed() });
  // For scripts and tests.
  window.nightsplat = { edits: list, path, camera: world.keyframe };

  return {
    load: (buffer) => { model = opened(buffer); if (edits.length) preview(); },
    // Whether a pointer is the tool's.
    begins: (x, y) => {
      if (!model || !['brush', 'up', 'scale'].includes(tool())) return false;
      if (tool() === 'brush') { stroke = { delete: [] }; brush(x, y); } else click(x, y);
      return true;
    },
    moves: (x, y) => { if (stroke) brush(x, y); return Boolean(stroke); },
    ends: () => { if (stroke) { const done = stroke; stroke = null; if (done.delete.length) commit(done); } },
  };
}
