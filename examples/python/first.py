"""A first look, cell by cell: a dataset, its diagnosis, a training, renders and scores.

    pip install nightsplat
    python first.py [PHOTOS] [OUT]      # without PHOTOS: a small synthetic dataset
"""

# %%
import pathlib
import sys

import numpy as np

import nightsplat

arguments = [pathlib.Path(argument) for argument in sys.argv[1:]]
out = arguments[1] if len(arguments) > 1 else pathlib.Path("first")
out.mkdir(exist_ok=True)
photos = arguments[0] if arguments else out / "photos"
if not arguments:
    nightsplat.synthetic_dataset(photos, size=(96, 72), views=16)
device = nightsplat.Device()
print(f"on {device.name}")

# %% The photographs, and what is decided from them
dataset = nightsplat.Dataset.load(photos)
dark = dataset.views[1].photograph()
assert dark is not None
found = nightsplat.diagnose(photos, device=device)
print(f"{len(dataset.views)} views; a photograph has a mean of {dark.mean():.3f}")
print(f"the light of the scene is multiplied by {found['scene']['brightening']:.1f}")

# %% A photograph as its target: the tone curve that training fits
bright = nightsplat.tone_map(dark, device=device)
nightsplat.save_image(out / "target.png", np.concatenate([dark, bright], axis=1))

# %% Training. Ctrl-C ends the loop between two steps, and the model is whole.
training = nightsplat.train(photos, preset="fast", steps=200, device=device)
try:
    for step in training:
        if step.step % 50 == 0:
            print(f"step {step.step}: loss {step.loss:.4f}, {step.gaussians} Gaussians")
    print(training.ended)
except KeyboardInterrupt:
    print("interrupted")
model = training.model()
model.save(out / "model.ply")

# %% Renders and scores of the test views
renderer = nightsplat.Renderer(model, device)
scores = []
for view in dataset.views:
    reference = view.reference()
    if reference is not None:
        render = renderer.render(view.camera)
        color = np.clip(render.color, 0, 1)
        nightsplat.save_image(out / f"{view.name}.png", np.concatenate([color, reference], axis=1))
        scores.append(nightsplat.psnr(color, reference))
print(f"{np.mean(scores):.2f} dB on {len(scores)} test views, in {out}")

# %% The Gaussians as arrays: those that are almost invisible are left out
arrays = model.arrays()
keeps = arrays["raw_opacities"] > np.log(0.02 / 0.98)
kept = nightsplat.Model.from_arrays(**{name: values[keeps] for name, values in arrays.items()}, origin=model.origin)
kept.save(out / "kept.spz")
print(f"{len(kept)} of {len(model)} Gaussians have an opacity above 0.02")
