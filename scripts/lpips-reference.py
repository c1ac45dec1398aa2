#!/usr/bin/env python3
"""Prints PyTorch's LPIPS of the images of tests/networks/lpips.rs, with the test's weights.

    pip install torch torchvision lpips
    scripts/lpips-reference.py
"""

import lpips
import numpy as np
import torch


def noise(count, salt):
    """Numbers in [-0.5, 0.5) by a multiplicative hash (Knuth), the same as the test's."""
    index = np.arange(count, dtype=np.uint64)
    return ((index + 1) * 2654435761 + salt * 97531) % 2**32 / 2**32 - 0.5


def picture(width, height, salt):
    values = noise(3 * width * height, salt).reshape(1, 3, height, width) + 0.5
    ramp = np.arange(width).reshape(1, 1, 1, width) / width
    return torch.tensor(0.5 * values + 0.5 * ramp, dtype=torch.float32)


def planted(net):
    """LPIPS of a network with weights from a formula."""
    model = lpips.LPIPS(net=net, pnet_rand=True, pretrained=False, verbose=False)
    state = model.state_dict()
    names = [name for name in state if name.startswith(("net.", "lin")) and not name.startswith("lins.")]
    for salt, name in enumerate(names):
        shape = tuple(state[name].shape)
        values = noise(int(np.prod(shape)), salt)
        if name.startswith("lin"):
            values = 4 * (values + 0.5) / shape[1]
        elif name.endswith("weight"):
            values = 2 * np.sqrt(6 / np.prod(shape[1:])) * values
        else:
            values = 0.1 * values
        state[name] = torch.tensor(values.reshape(shape), dtype=torch.float32)
        print(f'{salt:2} {name:22} {list(shape)}')
    model.load_state_dict(state, strict=False)
    for index in range(5):
        model.lins[index].model[1].weight.data = state[f"lin{index}.model.1.weight"]
    return model


for net, sizes in [("alex", [(31, 31), (64, 48), (97, 70)]), ("vgg", [(16, 16), (37, 22)])]:
    model = planted(net)
    for normalize in [True, False]:
        print(f"{net}, {'signed' if normalize else 'unit'}: width, height, far, near")
        for width, height in sizes:
            a, b = picture(width, height, 100), picture(width, height, 200)
            with torch.no_grad():
                far = model(a, b, normalize=normalize).item()
                near = model(a, 0.9 * a + 0.1 * b, normalize=normalize).item()
            print(f"({width}, {height}, {far:.6e}, {near:.6e})")
