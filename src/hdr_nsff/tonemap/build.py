"""The one place that knows which tone mappers there are."""

from __future__ import annotations

from typing import assert_never

from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig, ToneMapper
from hdr_nsff.tonemap.bracketed import FixedToneMapper, NetworkToneMapper, SharedToneMapper
from hdr_nsff.tonemap.identity import IdentityToneMapper
from hdr_nsff.tonemap.per_image import ImageToneMapper, SigmoidToneMapper
from hdr_nsff.tonemap.vignetting import vignetting_corners


def build_tone_mapper(config: ToneMapConfig, recordings: Recordings) -> ToneMapper:
    """An untrained tone mapper for the frames of `recordings`."""
    match config.kind:
        case "shared":
            return SharedToneMapper(config, recordings)
        case "fixed":
            return FixedToneMapper(config, recordings)
        case "mlp":
            return NetworkToneMapper(config, recordings)
        case "per_image":
            return ImageToneMapper(config, recordings)
        case "sigmoid":
            return SigmoidToneMapper(config, recordings)
        case "none":
            return IdentityToneMapper(config, recordings)
        case _:
            assert_never(config.kind)


def tone_mapper_for(config: ToneMapConfig, scene: Scene) -> ToneMapper:
    """The tone mapper of a prepared scene, before `ToneMapper.start`."""
    m = scene.manifest
    everyone = scene.train + scene.test
    num_cameras = max(f.camera_id for f in everyone) + 1
    shared = config.kind == "shared" and config.vignetting
    recordings = Recordings(
        brackets=tuple(f.bracket for f in scene.train),
        cameras=tuple(f.camera_id for f in scene.train),
        ev=tuple(m.known_ev),
        reference=m.reference_bracket,
        drift=tuple(f.drift for f in scene.train),
        balance=tuple(f.white_balance for f in scene.train),
        num_cameras=num_cameras,
        corners=vignetting_corners(scene, num_cameras) if shared else (),
    )
    return build_tone_mapper(config, recordings)
