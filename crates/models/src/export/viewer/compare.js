// The picture of a view over the left part of the model, up to a divider.

function comparison(stage) {
  const { state, views } = stage, divider = element('divider');
  // How much of the picture covers the model, and the left edge and width on the page of what is seen of it.
  let share = 0.5, across = [0, 1];
  const chosen = () => (state.bookmark === null ? null : views[state.bookmark].pictures[element('compare').value]);

  const show = () => {
    const picture = chosen();
    element('overlay').hidden = divider.hidden = !picture;
    element('before').setAttribute('aria-pressed', String(Boolean(picture)));
    if (!picture) return;
    const fit = placed(views[state.bookmark], canvas.clientWidth, canvas.clientHeight);
    const [width, height] = views[state.bookmark].size.map((v) => v * fit.zoom), left = Math.max(0, fit.left);
    across = [left, Math.min(width, canvas.clientWidth)];
    const at = left + share * across[1];
    Object.assign(element('overlay').style,
      { left: `${fit.left}px`, top: `${fit.top}px`, width: `${at - fit.left}px`, height: `${height}px` });
    Object.assign(divider.style,
      { left: `${at}px`, top: `${Math.max(0, fit.top)}px`, height: `${Math.min(height, canvas.clientHeight)}px` });
    divider.setAttribute('aria-valuenow', Math.round(100 * share));
    const image = element('picture');
    if (image.getAttribute('src') !== picture.image) image.src = picture.image;
    image.classList.toggle('difference', element('difference').checked);
    Object.assign(image.style, { width: `${width}px`, height: `${height}px` });
    element('leftText').textContent = picture.label;
  };
  const divide = (value) => { share = clamp(value, 0, 1); show(); };
  divider.addEventListener('pointerdown', (event) => divider.setPointerCapture(event.pointerId));
  divider.addEventListener('pointermove', (event) => {
    if (divider.hasPointerCapture(event.pointerId)) divide((onCanvas(event)[0] - across[0]) / across[1]);
  });
  divider.addEventListener('keydown', (event) => {
    const to = { ArrowLeft: share - 0.05, ArrowRight: share + 0.05, Home: 0, End: 1 }[event.key];
    if (to === undefined) return;
    divide(to);
    event.preventDefault();
  });
  stage.painters.push(show);
  const hasPictures = views.some(({ pictures }) => pictures.length);
  element('before').hidden = !hasPictures;

  // The view with a picture whose camera is nearest to where the camera is.
  const nearest = () => {
    const away = (k) => distance(stage.poses[k].eye, state.current.eye);
    const apart = views.map(({ pictures }, k) => (pictures.length ? away(k) : Infinity));
    return apart.indexOf(Math.min(...apart));
  };
  return {
    middle: () => { share = 0.5; },
    // The list of pictures of the view; the chosen one stays, if the new view has it.
    list: () => {
      const list = element('compare'), before = list.value;
      list.replaceChildren(new Option('model alone', ''));
      if (state.bookmark === null) return;
      const { pictures } = views[state.bookmark];
      pictures.forEach(({ label }, k) => list.add(new Option(label, String(k))));
      list.value = pictures[before] ? before : '';
    },
    // Shows or hides the photograph, from the nearest view that has one.
    toggle: () => {
      if (chosen()) {
        element('compare').value = '';
        stage.refresh();
        return;
      }
      const view = state.bookmark !== null && views[state.bookmark].pictures.length ? state.bookmark : nearest();
      const reveal = () => {
        stage.choose(view);
        element('compare').value = '0';
        stage.refresh();
      };
      if (view === state.bookmark) reveal(); else stage.flyTo(stage.poses[view], 0.8, reveal);
    },
  };
}
