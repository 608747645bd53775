"""What the facts of a clip mean: what will work, and what to shoot otherwise."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from hdr_nsff.check.facts import ClipFacts, ExposureFacts
from hdr_nsff.footage.footage import INTERLACED, deinterlacing
from hdr_nsff.prepare.length import offered_segments
from hdr_nsff.prepare.work import PrepareConfig
from hdr_nsff.radiometry.camera_brackets import MIN_CAMERA_STEP_EV
from hdr_nsff.radiometry.exposure_cycle import MIN_STEP, without_cycle

Level = Literal["good", "note", "warning", "problem"]


@dataclass(frozen=True)
class Finding:
    """One sentence about a clip, and advice where there is some."""

    level: Level
    subject: str
    text: str
    advice: str = ""


@dataclass(frozen=True)
class FindingTuning:
    """From when on a measured number is worth a sentence; hand-chosen."""

    max_step_ev: float = 3.3  # between neighboring exposures: they must share mid-tones
    # between cameras, which see different things, by brightness
    min_camera_step_ev: float = MIN_CAMERA_STEP_EV
    max_drift_ev: float = 0.3  # auto exposure; locked clips measure up to 0.13
    max_color_drift_ev: float = 0.2  # of red or blue against green
    max_white: float = 0.01  # share of pixels that even the darkest exposure saturates
    max_black: float = 0.02  # share that even the brightest leaves black
    min_sharpness: float = 0.8  # of the longest exposure relative to the shortest
    max_motion: float = 0.03  # of the picture's width, from frame to frame
    min_banding_ev: float = 0.05
    max_interval_ratio: float = 1.5  # longest to shortest time between frames
    min_readout: float = 0.1  # share of the time between frames
    min_speed: float = 5e-4  # of the picture's width a frame, below which it hardly moves
    # shake relative to speed: 0.06 and 0.09 for a drone and a camera that stabilizes,
    # 0.13 and more for hands and the heads of tripods
    max_smooth: float = 0.1
    few_frames: int = 12
    many_frames: int = 150
    sure_parallax: float = 0.5  # rotations explain less than this share: parallax is clear


def judge(facts: ClipFacts, tuning: FindingTuning = FindingTuning()) -> list[Finding]:
    """Findings in the order in which a user decides."""
    return [
        *judge_exposure(facts, tuning),
        *judge_cameras(facts, tuning),
        *judge_clipping(facts, tuning),
        *judge_camera(facts, tuning),
        *judge_file(facts, tuning),
        *judge_lens(facts),
        *judge_shutter(facts, tuning),
        *judge_stabilization(facts, tuning),
    ]


def outlook(facts: ClipFacts) -> dict[str, str]:
    """What will work, by purpose: yes, partly or no, and why."""
    exposure, camera = facts.exposure, facts.camera
    varies = max(exposure.ev) >= MIN_STEP
    drift = exposure.drift_ev if exposure.given is None else exposure.given_drift_ev
    hdr = "no: one exposure shows no light beyond its white"
    if exposure.contradictions:
        hdr = f"unknown: {exposure.given} and the pixels disagree"
    elif varies or jumps(exposure, FindingTuning()):
        hdr = "yes"
    elif drift > FindingTuning().max_drift_ev:
        hdr = f"partly: the exposure drifts by about {drift:.1f} EV"
    views = {
        "parallax": "yes, near the filmed path",
        "rotation": "no: the camera only turns, so there is no depth",
        "tripod": "no: the camera stands still, so there is no depth",
        "unknown": "unknown: too few points match between distant frames",
    }[camera.motion]
    if facts.file.cameras > 1 and not facts.file.same_camera:
        views = "yes, between cameras that see the same"
    if any(camera.contradictions for camera in facts.each_camera):
        hdr = f"unknown: {exposure.given} and the pixels disagree"
    elif different_cameras(facts, FindingTuning()):
        hdr = "yes"
    times = "yes" if not camera.cuts else "only within a shot: the clip has cuts"
    return {"HDR": hdr, "new viewpoints": views, "times between frames": times}


def judge_exposure(facts: ClipFacts, tuning: FindingTuning) -> Iterator[Finding]:
    """The cycle, or what is there instead."""
    exposure = facts.exposure
    ordered = sorted(exposure.ev)
    one_each = different_cameras(facts, tuning) > 0 and ordered[-1] < MIN_STEP
    if one_each and not exposure.contradictions:
        pass  # `judge_cameras` says by how much they differ
    elif exposure.given is not None:
        yield from judge_given(exposure, exposure.given, tuning)
    elif exposure.cycle > 1:
        levels = ", ".join(f"{value:.1f}" for value in ordered)
        text = (
            f"the exposure alternates in a cycle of {exposure.cycle} frames at about {levels} EV "
            f"(by brightness, gamma 2.2), which explains {exposure.explained:.0%} of its changes"
        )
        yield Finding("good", "exposure", text)
    elif exposure.change_ev > MIN_STEP:
        first, end = facts.measured
        text = without_cycle(exposure.change_ev, end - first)
        yield Finding("warning", "exposure", text, "list the exposures in exposures.csv")
    else:
        text = "the exposure does not alternate, so light beyond its white is not recorded"
        level: Level = "warning" if exposure.drift_ev > tuning.max_drift_ev else "problem"
        yield Finding(level, "exposure", text, "alternate two or three exposures")
    widest = max((b - a for a, b in itertools.pairwise(ordered)), default=0.0)
    if widest > tuning.max_step_ev:
        text = f"two exposures are {widest:.1f} EV apart and share few mid-tones"
        yield Finding("warning", "exposure", text, "use steps of 1 to 3 EV, or a third exposure")
    if exposure.empty:
        advice = "leave them out (--start, --end), or give `prepare` the exposures: --ev"
        yield Finding("warning", "exposure", exposure.empty, advice)
    jumping = exposure.cycle == 1 and exposure.change_ev > MIN_STEP  # said above
    if exposure.drift_ev > tuning.max_drift_ev and exposure.given is None and not jumping:
        text = f"the exposure drifts by about {exposure.drift_ev:.1f} EV: auto exposure"
        advice = "`prepare` follows it, but lock exposure and white balance if you can"
        yield Finding("warning", "exposure", text, advice)
    if exposure.color_drift_ev > tuning.max_color_drift_ev:
        text = f"colors drift by about {exposure.color_drift_ev:.2f} EV: auto white balance"
        advice = "`prepare` follows a slow drift, but lock white balance if you can"
        yield Finding("warning", "color", text, advice)
    if exposure.banding_ev > tuning.min_banding_ev:
        text = f"bands of about {exposure.banding_ev:.2f} EV run through the picture: mains flicker"
        advice = "use exposure times of 1/50 or 1/100 s (1/60 or 1/120 s where mains have 60 Hz)"
        yield Finding("warning", "flicker", text, advice)


def judge_given(exposure: ExposureFacts, source: str, tuning: FindingTuning) -> Iterator[Finding]:
    """What the exposures that a `source` gives are, and whether the pixels agree."""
    count, span, drift = len(exposure.ev), max(exposure.ev), exposure.given_drift_ev
    advice = ""
    if span >= MIN_STEP:
        level: Level = "good"
        text = f"{count} exposures are given by {source}, {span:.1f} EV in all"
        if drift > tuning.max_drift_ev:
            text += f", which drift by {drift:.1f} EV: auto exposure"
    elif jumps(exposure, tuning):
        level = "good"
        text = f"the exposures that {source} gives range over {drift:.1f} EV, in no cycle"
    else:
        level = "warning" if drift > tuning.max_drift_ev else "problem"
        advice = "alternate two or three exposures"
        text = f"one exposure is given by {source}"
        if drift > 0:
            text = f"the exposures that {source} gives drift by {drift:.2f} EV: auto exposure"
        text += ", so light beyond its white is not recorded"
    if exposure.contradictions:
        level, advice = "note", ""
    yield Finding(level, "exposure", text, advice)
    for sentence in exposure.contradictions:
        text = f"{source} and the pixels disagree: {sentence}"
        advice = "correct it, or give `prepare` the option `--exposures auto` to go by brightness"
        yield Finding("warning", "exposure", text, advice)


def jumps(exposure: ExposureFacts, tuning: FindingTuning) -> bool:
    """Whether exposures of no cycle are given that differ from frame to frame."""
    return exposure.given_drift_ev > tuning.max_drift_ev and exposure.change_ev > MIN_STEP


def judge_cameras(facts: ClipFacts, tuning: FindingTuning) -> Iterator[Finding]:
    """How several cameras, or tracks of one, are exposed."""
    count = len(facts.each_camera)
    if not count:
        return
    what = "tracks" if facts.file.same_camera else "cameras"
    lengths = [camera.cycle for camera in facts.each_camera]
    span = different_cameras(facts, tuning)
    by = facts.exposure.given or "brightness"
    if len(set(lengths)) > 1 and facts.exposure.given is not None:
        text = f"the exposures of the {what} repeat after {lengths} frames (by {by})"
        yield Finding("note", what, text)
    elif len(set(lengths)) > 1:
        text = f"the {what} disagree on the length of the exposure cycle: {lengths}"
        yield Finding("warning", what, text, "list the exposures in exposures.csv")
    elif span:
        text = f"the {count} {what} are exposed differently, by up to {span:.1f} EV (by {by})"
        yield Finding("good", what, text)
    else:
        yield Finding("note", what, f"the {count} {what} are exposed alike (by {by})")
    for camera in facts.each_camera[1:]:
        for sentence in camera.contradictions:
            text = f"{camera.name}: {by} and the pixels disagree: {sentence}"
            yield Finding("warning", what, text, "correct the exposures")
    text = f"movement, lens and shutter are measured of the first of the {count} {what} only"
    yield Finding("note", what, text)


def different_cameras(facts: ClipFacts, tuning: FindingTuning) -> float:
    """EV between the least and the most exposed of several cameras or tracks; 0 where
    they are exposed alike.
    """
    levels = [c.level_ev for c in facts.each_camera if c.level_ev is not None]
    span = max(levels, default=0.0) - min(levels, default=0.0)
    least = tuning.min_camera_step_ev
    if facts.exposure.given is not None or facts.file.same_camera:
        least = MIN_STEP
    return span if span >= least else 0.0


def judge_clipping(facts: ClipFacts, tuning: FindingTuning) -> Iterator[Finding]:
    """What no exposure recorded."""
    exposure, several = facts.exposure, different_cameras(facts, tuning)
    darkest = exposure.ev.index(min(exposure.ev))
    brightest = exposure.ev.index(max(exposure.ev))
    white, black = exposure.white_share[darkest], exposure.black_share[brightest]
    if several:
        white = min(camera.white_share for camera in facts.each_camera)
        black = min(camera.black_share for camera in facts.each_camera)
    single = len(exposure.ev) == 1 and not several
    one = "the" if single else "even the darkest"
    if white > tuning.max_white:
        text = f"{one} exposure saturates {white:.1%} of the picture"
        yield Finding("warning", "highlights", text, "add a darker exposure")
    else:
        yield Finding("good", "highlights", f"{one} exposure saturates {white:.1%} of the picture")
    if black > tuning.max_black:
        one = "the" if single else "even the brightest"
        text = f"{one} exposure leaves {black:.1%} of the picture black"
        yield Finding("warning", "shadows", text, "add a brighter exposure")


def judge_camera(facts: ClipFacts, tuning: FindingTuning) -> Iterator[Finding]:
    """Parallax, blur, speed, cuts."""
    camera = facts.camera
    share = camera.rotation_share  # None where a picture that keeps its place decided it
    why = "" if share is None else f": turns alone explain {share:.0%} of the matches"
    if camera.motion == "unknown":
        text = "too few points match between distant frames to see how the camera moves"
        advice = "film something with texture, with smaller steps of exposure, or give --poses"
        yield Finding("warning", "camera", text, advice)
    elif camera.motion == "parallax":
        sure = share is not None and share < tuning.sure_parallax
        advice = "" if sure else "little parallax: move farther to the side"
        text = f"the camera moves through space{why}"
        yield Finding("good" if sure else "note", "camera", text, advice)
    else:
        did = "stands still" if camera.motion == "tripod" else "turns, or hardly moves"
        text = f"the camera {did}{why}"
        advice = "for new viewpoints, move sideways or in an arc; HDR and slow motion work as it is"
        if facts.file.cameras > 1 and not facts.file.same_camera:
            text = f"the first of {facts.file.cameras} cameras {did}"
            advice = "for new viewpoints, the cameras have to see the same from different places"
        yield Finding("note", "camera", text, advice)
    if camera.long_sharpness is not None and camera.long_sharpness < tuning.min_sharpness:
        text = f"the longest exposure has {camera.long_sharpness:.0%} of the shortest one's edges"
        yield Finding("warning", "blur", text, "shorten it and raise the gain, or move slower")
    share_of_width = camera.pixels_per_frame / facts.file.width
    if share_of_width > tuning.max_motion:
        text = f"the picture moves by {share_of_width:.0%} of its width from frame to frame"
        yield Finding("warning", "camera", text, "move slower, or record more frames a second")
    if camera.cuts:
        listed = ", ".join(str(cut) for cut in camera.cuts[:6])
        first, end = facts.measured
        text = f"the first {facts.looked_at} frames are cut at frame {listed}"
        text += f"; exposures and camera are those of frames {first} to {end - 1}"
        advice = "`prepare` makes a scene of each part; for one of them, --start A --end B"
        yield Finding("problem", "cuts", text, advice)


def judge_lens(facts: ClipFacts) -> Iterator[Finding]:
    """Distortion, where a camera with parallax shows it."""
    lens = facts.camera.lens
    if lens is None:
        text = "lens distortion is not measured: that takes a camera that moves through space"
        yield Finding("note", "lens", text, "avoid very wide lenses")
    elif lens.corner_px == 0:
        yield Finding("good", "lens", "straight lines stay straight")
    else:
        text = f"the lens moves corners by {lens.corner_px:.0f} px (k1 {lens.k1:.3f})"
        yield Finding("note", "lens", text, "`prepare` undistorts the frames")


def judge_shutter(facts: ClipFacts, tuning: FindingTuning) -> Iterator[Finding]:
    """Rolling shutter, where the camera's shake shows it."""
    if facts.camera.motion == "tripod":
        return
    if facts.camera.readout is None:
        text = (
            "rolling shutter is not measured: the camera shakes too little, or too little matches"
        )
        yield Finding("note", "shutter", text)
        return
    readout, error = facts.camera.readout
    ms = facts.file.frame_ms or 1000 / facts.file.fps
    if readout < max(tuning.min_readout, 2 * error):
        most = max(tuning.min_readout, readout + 2 * error)
        text = f"no rolling shutter is seen (less than {most:.0%} of the time between frames)"
        yield Finding("good", "shutter", text)
        return
    text = f"rolling shutter: rows are read over {readout:.0%} of the time between frames"
    text += f" (standard error {error:.0%})"
    advice = "move slower"
    if facts.file.interval_ms is not None:
        text += f", {readout * ms:.0f} ms"
        advice += f", or give `--readout {readout * ms:.0f}` (or auto) to `prepare` or `run`"
    yield Finding("note", "shutter", text, advice)


def judge_stabilization(facts: ClipFacts, tuning: FindingTuning) -> Iterator[Finding]:
    """Electronic stabilization, as the camera wrote, else by what is left of shake."""
    subject, off = "stabilizer", "turn electronic stabilization off"
    if facts.file.stabilized is not None:
        on = facts.file.stabilized
        text = f"electronic stabilization was {'on' if on else 'off'}, as the camera wrote"
        yield Finding("warning" if on else "good", subject, text, "turn it off" if on else "")
        return
    if facts.camera.shake is None:
        text = "stabilization is not measured: too few frames in a row match"
        yield Finding("note", subject, text, off)
        return
    shake, speed = facts.camera.shake
    if facts.camera.motion == "tripod" or speed < tuning.min_speed * facts.file.width:
        text = "the picture hardly moves, so electronic stabilization does not show"
        yield Finding("note", subject, text, off)
        return
    measured = f"from frame to frame it moves by {speed:.1f} px, which change by {shake:.1f} px"
    if shake < tuning.max_smooth * speed:
        text = f"the picture moves as if on rails, held by a gimbal or stabilized: {measured}"
        yield Finding("note", subject, text, off)
    else:
        text = f"the picture shakes, as it does without electronic stabilization: {measured}"
        yield Finding("good", subject, text)


def judge_file(facts: ClipFacts, tuning: FindingTuning) -> Iterator[Finding]:
    """Length, timing and tags."""
    file = facts.file
    match file.kind:
        case "linear":
            kind = "linear frames"
        case "recorded":
            kind = f"{file.bits} bits"
        case _:
            kind = f"{file.kind} of {file.bits} bits, brought to linear light by its tags"
    count = f"{file.frames} frames" if file.frames else "frames"
    if file.cameras > 1:
        count = f"{file.cameras} {'tracks' if file.same_camera else 'cameras'} of {count}"
    size = f"{file.width} x {file.height}, {file.fps:.4g} a second"
    yield Finding("note", "file", f"{count} of {size}; {kind}")
    if file.interlaced:
        yield Finding("warning", "interlaced", INTERLACED, deinterlacing(file.name))
    if file.bars:
        yield Finding("note", "file", file.bars)
    if 0 < file.frames < tuning.few_frames:
        text = f"{file.frames} frames are few"
        yield Finding("warning", "length", text, "record two seconds or more")
    shrink = min(1.0, PrepareConfig.max_size / max(file.width, file.height))
    num_pixels = round(shrink * file.width) * round(shrink * file.height)
    offer = offered_segments(file.frames, num_pixels, file.fps)
    if offer is not None:
        advice = f"{offer.advice('hdr-nsff run')}, or choose a part with --start and --end"
        yield Finding("note", "length", offer.sentence(file.frames), advice)
    elif file.frames > tuning.many_frames and not facts.camera.cuts:
        text = f"{file.frames} frames take long, and most of that time repeats itself"
        yield Finding("note", "length", text, "choose a part with --start and --end")
    if facts.exposure.missing_before:
        listed = ", ".join(str(frame) for frame in facts.exposure.missing_before[:6])
        text = f"frames are missing before frame {listed}: the exposure cycle skips a part"
        advice = "`prepare` leaves gaps in time; use a faster card, or record at a lower rate"
        yield Finding("warning", "timing", text, advice)
    if file.timestamps_problem:
        text = f"{file.timestamps_problem}; frames are taken as evenly spaced"
        yield Finding("warning", "timing", text, "correct the column, or leave it out")
    if file.missing:
        many = "1 frame is" if file.missing == 1 else f"{file.missing} frames are"
        text = f"{many} missing by the timestamps"
        advice = "`prepare` leaves gaps in time; use a faster card, or record at a constant rate"
        yield Finding("warning", "timing", text, advice)
    if file.interval_ms is not None:
        shortest, longest = file.interval_ms
        if longest > tuning.max_interval_ratio * shortest:
            text = f"variable frame rate: {shortest:.0f} to {longest:.0f} ms between frames"
            advice = "frames are taken as evenly spaced; record at a constant rate"
            yield Finding("warning", "timing", text, advice)
