"""Groups of a deformation network's parameters: by the beginnings of their names, whatever the network is made of.

The sibling of groups.py, whose groups are entries of Gaussians. A scene that moves names the parameters of its network
`phi.grid.*` and `phi.mlp.*`; all that a group holds is one flat vector of information, in the order of
`Scene.parameters()`.
"""

from __future__ import annotations

import torch

from drgs.ellipsoids import DeformableScene, Scene

NETWORK_GROUPS = {"grid": "phi.grid.", "mlp": "phi.mlp."}
"""Group -> what the names of its parameters begin with."""


def network_groups(scene: Scene) -> dict[str, dict[str, torch.Tensor]]:
    """Group -> the scene's float tensors by name; groups without any are left out, so that most scenes have none."""
    if not isinstance(scene, DeformableScene):
        return {}
    floats = {name: x for name, x in scene.parameters().items() if x.is_floating_point()}
    groups = {
        group: {name: x for name, x in floats.items() if name.startswith(prefix)}
        for group, prefix in NETWORK_GROUPS.items()
    }
    return {group: own for group, own in groups.items() if own}


def network_lengths(scene: Scene) -> dict[str, torch.Tensor]:
    """Group -> (P,) bool: its parameters that are lengths (`drgs.deform.LENGTHS`); groups without any are left out."""
    groups = network_groups(scene)
    if not groups:
        return {}
    from drgs.deform import LENGTHS, PHI  # scenes that do not move have none

    lengths = {PHI + name for name in LENGTHS}
    found = {
        group: torch.cat([torch.full((x.numel(),), name in lengths) for name, x in own.items()])
        for group, own in groups.items()
    }
    return {group: own for group, own in found.items() if bool(own.any())}
