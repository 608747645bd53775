"""The synthetic scenes: each is hard in another way."""

from hdr_nsff.synth_scenes.base import SynthScene
from hdr_nsff.synth_scenes.cloth import CLOTH
from hdr_nsff.synth_scenes.interior import INTERIOR
from hdr_nsff.synth_scenes.lamp import LAMP
from hdr_nsff.synth_scenes.night import NIGHT

SCENES: dict[str, SynthScene] = {"interior": INTERIOR, "lamp": LAMP, "night": NIGHT, "cloth": CLOTH}
