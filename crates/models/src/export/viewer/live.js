// Follows a training: asks the page's server for progress, and for the model when it has changed.

const ASK_EVERY = 1000;  // milliseconds
// How long a page waits for the file that it asked a training to save.
const SAVED_WITHIN = 60000;
// The most views whose photographs an exported page has.
const MOST_SHARED = 8;

async function asked(path) {
  const response = await fetch(path, { cache: 'no-store' });
  if (!response.ok) throw new Error(`${path}: ${response.status}`);
  return response;
}

function duration(seconds) {
  const minutes = Math.floor(seconds / 60);
  if (minutes >= 60) return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
  return minutes ? `${minutes} min` : `${Math.ceil(seconds)} s`;
}

// The progress on one line.
function summary(state) {
  const { phase, step, steps, loss, gaussians, milliseconds, heldOut = [], modelStep, problem } = state;
  const parts = [];
  if (phase !== 'model') parts.push(phase === 'training' && !step ? 'starting' : phase);
  if (step) parts.push(`step ${step}${steps ? ` of at most ${steps}` : ''}`);
  if (loss !== null && loss !== undefined) parts.push(`loss ${loss.toFixed(4)}`);
  if (gaussians) parts.push(`${gaussians} Gaussians`);
  if (heldOut.length) parts.push(`held-out views ${heldOut.at(-1)[1].toFixed(2)} dB`);
  if (phase === 'training' && milliseconds) {
    parts.push(`${milliseconds.toFixed(0)} ms a step`);
    if (steps > step) parts.push(`at most ${duration((steps - step) * milliseconds / 1000)} left`);
  }
  if (modelStep) parts.push(`the model of step ${modelStep}`);
  if (problem) parts.push(problem);
  return parts.join(' · ');
}

// The scores of the held-out views as a curve.
function plot(heldOut) {
  const [steps, scores] = [0, 1].map((k) => heldOut.map((score) => score[k]));
  const scaled = (values, size) => {
    const [least, most] = [Math.min(...values), Math.max(...values)];
    return values.map((value) => (value - least) / (most - least || 1) * size);
  };
  const [x, y] = [scaled(steps, 120), scaled(scores, 22)];
  element('line').setAttribute('points', x.map((value, k) => `${value},${23 - y[k]}`).join(' '));
}

// Bytes as a data URI.
const asUri = (blob) => new Promise((done, failed) => {
  const reader = new FileReader();
  [reader.onload, reader.onerror] = [() => done(reader.result), failed];
  reader.readAsDataURL(blob);
});

// A page for sharing, of the model that is shown: this page with its model and photographs of some views within.
async function sharedPage(source, buffer) {
  const every = Math.max(1, Math.ceil(scene.views.length / MOST_SHARED));
  const views = scene.views.filter((_, k) => k % every === 0), pictures = views.map(async (view) => {
    // Of a server that has ended, the page has none.
    const fetched = async (image) => asUri(await (await asked(image)).blob());
    const images = view.pictures.map(async ({ label, image }) => ({ label, image: await fetched(image) }));
    return (await Promise.allSettled(images)).flatMap(({ value }) => value ?? []);
  });
  const own = { ...scene, isLive: false, showsCameras: false, views: [] };
  for (const [k, view] of views.entries()) own.views.push({ ...view, pictures: await pictures[k] });
  const packed = await new Response(new Blob([buffer]).stream().pipeThrough(new CompressionStream('gzip'))).blob();
  const model = (await asUri(packed)).replace(/^.*,/, '');
  const within = (page, id, text) =>
    page.replace(new RegExp(`([<]script id="${id}"[^>]*>)[^<]*`), (_, begin) => begin + text);
  return within(within(source, 'scene', JSON.stringify(own).replaceAll('<', '\\u003c')), 'model', model);
}

// The file of the model: of a training under way, as it is now, in full.
async function modelFile(state, order, wait) {
  const { file: before, canControl } = state();
  if (canControl) {
    await order('save');
    for (let waited = 0; waited < SAVED_WITHIN && state().file?.saved === before?.saved; waited += ASK_EVERY) await wait();
  }
  return { name: state().file.name, blob: await (await asked('file')).blob() };
}

// Shows every model that comes; returns once the first is shown.
async function follow(show) {
  element('live').hidden = scene.showsCameras;
  let version = 0, isPaused = false, hasEnded = false, buffer = null, latest = {};
  const source = await (await asked('')).text();
  const order = async (what) => { await fetch(`do/${what}`, { method: 'POST' }); await look(); };
  element('pause').addEventListener('click', () => order(isPaused ? 'resume' : 'pause'));
  for (const what of ['save', 'finish', 'stop']) element(what).addEventListener('click', () => order(what));
  element('exportPage').addEventListener('click', async () => {
    download('model.html', new Blob([await sharedPage(source, buffer)], { type: 'text/html' }));
  });
  element('exportModel').addEventListener('click', async () => {
    const wait = () => new Promise((done) => setTimeout(done, ASK_EVERY)).then(look);
    try {
      const { name, blob } = await modelFile(() => latest, order, wait);
      download(name, blob);
    } catch (error) {
      element('progress').textContent = `the model cannot be downloaded: ${error.message}`;
    }
  });

  async function look() {
    const state = await (await asked('state')).json();
    latest = state;
    element('exportModel').hidden = !state.file && !state.canControl;
    isPaused = state.phase === 'paused';
    hasEnded = Boolean(state.endedBy);
    element('progress').textContent = state.endedBy ?? summary(state);
    element('controls').hidden = !state.canControl;
    element('pause').textContent = isPaused ? 'Continue' : 'Pause';
    plot(state.heldOut ?? []);
    scene.model = state.fingerprint;
    element('editor').hidden = !scene.model;
    if (state.model !== version) {
      buffer = await (await asked('model')).arrayBuffer();
      show(buffer);
      version = state.model;
      root.dataset.version = String(version);
    }
  }
  async function again() {
    try {
      if (!document.hidden) await look();
    } catch (error) {
      element('progress').textContent =
        'the program that serves this page has ended or cannot be reached; the last model is shown';
      element('controls').hidden = element('exportModel').hidden = true;
    }
    if (!hasEnded) setTimeout(again, ASK_EVERY);
  }
  await look();
  if (!version) say('Waiting for the first model …');
  while (!version) {
    await new Promise((done) => setTimeout(done, ASK_EVERY));
    await look();
  }
  element('exports').hidden = false;
  setTimeout(again, ASK_EVERY);
}
