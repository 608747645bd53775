"""Settings of `synth` that make no sense are refused in a sentence."""

from dataclasses import replace

import pytest
from synth_scene import Flat

from hdr_nsff.core.errors import InputError
from hdr_nsff.synth.scenes.walk import RIGHT, WALK
from hdr_nsff.synth.settings import SynthConfig, parse_ev, parse_size, parse_white_balance
from hdr_nsff.synth.synth import synth


@pytest.mark.parametrize(
    "text", ["240", "240x", "axb", "8x8", "-240x136", "9999x9999", "9" * 5000 + "x16"]
)
def test_a_bad_size_is_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(InputError, match="WIDTHxHEIGHT"):
        parse_size(text)


@pytest.mark.parametrize("text", ["", "a,b", "1,,2", "nan,0", "inf", "61", "-40,40"])
def test_bad_exposures_are_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(InputError, match="--ev"):
        parse_ev(text)


@pytest.mark.parametrize("text", ["1,1", "a,b,c", "0,1,1", "nan,1,1", "1,1,1,1"])
def test_a_bad_white_balance_is_refused_in_a_sentence(text: str) -> None:
    with pytest.raises(InputError, match="--white-balance"):
        parse_white_balance(text)


@pytest.mark.parametrize(
    "change",
    [
        *(
            {"frames": 3},
            {"seed": -1},
            {"spp": 0},
            {"spp": 10**7},
            {"truth_spp": 10**400},
            {"noise": -1.0},
            {"noise": float("nan")},
            {"response": "kodak"},
        ),
        *({"lens": "-3"}, {"lens": "much"}, {"lens": "0.1,0,0"}, {"lens": "-0.1"}),
        *({"vignetting": 1.1}, {"vignetting": float("nan")}, {"white_balance": "1"}),
        *({"depth_noise": 1.0}, {"depth_grain": -0.1}, {"flow_noise": float("nan")}),
    ],
)
def test_bad_numbers_are_refused_before_anything_is_rendered(
    flat: SynthConfig, change: dict
) -> None:
    with pytest.raises(InputError):
        synth(replace(flat, **change))
    assert Flat.rendered == 0 and not flat.out.exists()


def test_a_clip_ends_before_a_mover_leaves_the_scene(flat: SynthConfig) -> None:
    """The walker, moved on by a frame for flow, is still before the wall."""
    longest = WALK.max_frames
    ahead = [WALK.vertices(p, longest)[:, 0].max() for p in WALK.build(0) if "walker" in p.body]
    assert 0 < RIGHT - max(ahead) < 0.3
    with pytest.raises(InputError, match=f"from 12 to {longest} for walk"):
        synth(replace(flat, name="walk", frames=longest + 1))
