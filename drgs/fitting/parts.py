"""What a fit is made of besides its photographs and Gaussians: here a new term, tensor or network is put in."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from drgs.ellipsoids import Scene
from drgs.fitting.config import FitConfig
from drgs.fitting.filter_3d import Filter3D
from drgs.fitting.losses import LossTerm, Opacity, Scale, terms_of
from drgs.fitting.networks import Network, Rate
from drgs.fitting.rows import GaussianRows

if TYPE_CHECKING:
    from drgs.fitting.exposure import ExposureEstimate
    from drgs.fitting.frames import Frame
    from drgs.fitting.poses import Poses
    from drgs.integrator import Output

__all__ = ["Parts", "means_rate", "parts_of", "with_exposure", "with_poses", "with_skybox", "without_exposure"]


@dataclasses.dataclass(frozen=True)
class Parts:
    """What a fit is made of.

    Attributes:
        terms: Terms of the loss, in the order in which they are added up.
        rates: Learning rates by the name of the tensor in `GaussianRows`.
        networks: What is fitted beside the Gaussians, and called by terms or by the scene.
        scene: What is rendered of the rows: their Gaussians, or a scene that has others at the time of a view.
        shows_features: Whether the features, if there are any, are rendered with the colors of a photograph; default
            always. Terms get the Gaussians with their features either way.
        couple_features: Whether gradients of the features that are rendered reach the geometry.
        filter_3d: The low-pass filter that is in `scene` already; None: there is none.
        exposure: What a photograph shows of a rendering, before terms of the loss see it; None: the rendering.
        poses: Cameras of photographs as they are fitted, one of `networks`; None: they stay where the data set says.
    """

    terms: Sequence[LossTerm]
    rates: Mapping[str, Rate]
    networks: Sequence[Network] = ()
    scene: Callable[[GaussianRows], Scene] = GaussianRows.gaussians
    shows_features: Callable[[Frame], bool] | None = None
    couple_features: bool = True
    filter_3d: Filter3D | None = None
    exposure: Callable[[Output, Frame], Output] | None = None
    poses: Poses | None = None


def parts_of(config: FitConfig, extent: float, channels: int | None = None) -> Parts:
    """The parts of a fit with a config.

    Args:
        config: Configuration of the fit.
        extent: Extent of the scene, its unit of length.
        channels: Channels of the maps of a teacher, to which features and a decoder are fitted; None: no features.
    """
    rates: dict[str, Rate] = {
        "means": lambda part: means_rate(config, part) * extent,
        "quats": config.rates.rotation_rate,
        "log_scales": config.rates.scale_rate,
        "logit_opacities": config.rates.opacity_rate,
        "sh_dc": config.rates.dc_rate,
        "sh_rest": config.rates.rest_rate,
    }
    parts = Parts(terms_of(config, extent), rates)
    if config.filter_3d == "on":
        filter_3d = Filter3D()
        parts = dataclasses.replace(parts, scene=lambda rows: filter_3d(rows.gaussians()), filter_3d=filter_3d)
    if channels is None:
        return parts
    from drgs.fitting.semantics import features_of

    term, decoder = features_of(config, channels)
    return dataclasses.replace(
        parts,
        terms=[*parts.terms, term],
        rates={**parts.rates, "features": config.features.feature_rate},
        networks=[*parts.networks, decoder],
        shows_features=term.is_shown,
        couple_features=config.features.couple_features,
    )


def means_rate(config: FitConfig, part: float) -> float:
    """Learning rate of the means, in units of the extent, when the fraction `part` of the fit is done."""
    first, last = config.rates.means_rate
    return first * (last / first) ** part


def with_exposure(
    parts: Parts, frames: list[Frame], config: FitConfig, estimate: ExposureEstimate | None = None
) -> Parts:
    """The parts with gains of photographs.

    Args:
        parts: Parts of a fit without.
        frames: Its training photographs.
        config: Its configuration, whose `data.exposure` is not `off`.
        estimate: What points say of the gains; None where a checkpoint brings them.
    """
    from drgs.fitting.exposure import exposure_network

    network = exposure_network(
        frames,
        config.data.exposure == "learned",
        None if estimate is None else estimate.log_gains,
        config.settings.background,
    )
    return dataclasses.replace(parts, networks=[*parts.networks, network], exposure=network.module)


def without_exposure(parts: Parts) -> Parts:
    """The parts with one exposure for all photographs."""
    networks = [network for network in parts.networks if network.module is not parts.exposure]
    return dataclasses.replace(parts, networks=networks, exposure=None)


def with_skybox(parts: Parts, count: int) -> Parts:
    """The parts with terms that leave the first `count` Gaussians, which are far away, out of means over all."""
    return dataclasses.replace(
        parts,
        terms=[
            dataclasses.replace(term, skybox=count) if isinstance(term, (Opacity, Scale)) else term
            for term in parts.terms
        ],
    )


def with_poses(parts: Parts, frames: list[Frame], config: FitConfig, extent: float, reach: float = 0.0) -> Parts:
    """The parts with poses of photographs, as stated until they are fitted.

    Args:
        parts: Parts of a fit without.
        frames: Its training photographs.
        config: Its configuration.
        extent: Extent of the scene, its unit of length.
        reach: How far a pose may move what its picture shows, root mean square in pixels; of a fit that goes on it is
            the checkpoint's.
    """
    from drgs.fitting.poses import Poses, pose_network

    poses = Poses([frame.camera for frame in frames], extent, config.settings, reach)
    return dataclasses.replace(parts, networks=[*parts.networks, pose_network(poses)], poses=poses)
