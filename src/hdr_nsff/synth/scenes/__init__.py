"""The synthetic scenes by name. Each is difficult in its own way."""

from hdr_nsff.synth.scenes.base import SynthScene
from hdr_nsff.synth.scenes.cloth import CLOTH
from hdr_nsff.synth.scenes.interior import INTERIOR
from hdr_nsff.synth.scenes.lamp import LAMP
from hdr_nsff.synth.scenes.night import NIGHT
from hdr_nsff.synth.scenes.walk import WALK

SCENES: dict[str, SynthScene] = {
    "interior": INTERIOR,
    "lamp": LAMP,
    "night": NIGHT,
    "cloth": CLOTH,
    "walk": WALK,
}
