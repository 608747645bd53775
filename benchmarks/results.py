"""Writes docs/results.md from the JSON files in benchmarks/results/.

    python benchmarks/results.py            # write the page
    python benchmarks/results.py --check    # exit code 1 where the page is out of date

Every number of the page stands in one of these files, which the command above its
table wrote. A file that is not there is listed at the end of the page.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from markdown_tables import Lines, number, pair, table
from record import RESULTS, ROOT

from hdr_nsff.core.io import write_text

PAGE = ROOT / "docs" / "results.md"
INTRO = "# Results\n\n" + (
    "`python benchmarks/results.py` writes this page from the JSON files in `benchmarks/results`: "
    "one current number per claim, with its command, machine, commit and seed. PSNR is of "
    "recorded values in dB, over full pictures and over moving pixels; HDR is the mu-law PSNR of "
    "linear radiance after one scale, which unrecorded lights decide ([metrics](metrics.md)). "
    "`sensitivity.json` there holds the tuning constants of the priors at half and double."
)

Document = dict[str, Any]


@dataclass(frozen=True)
class Section:
    """A part of the page that one JSON file fills."""

    file: str  # name in benchmarks/results, without .json
    title: str
    about: str  # what was measured, and what the table shows
    command: str
    body: Callable[[Document], Lines]


FIELDS = "bench-fields"  # both fields on real clips, in equal time
RIG_POSES = "rig-poses"  # priors of rigs at 160x90, by `priors.py`


def origin(document: Document) -> str:
    """The machine, commit and seed of a file, in a line."""
    machine = document["machine"]
    trained = dict.fromkeys(run["commit"] for run in document["results"] if run.get("commit"))
    commits = list(trained) or document.get("commits") or [document["commit"] or "unknown"]
    commit = ", ".join(name[:9] for name in commits)
    changed = ", with changes" if document["dirty"] and not trained else ""
    day = document["date"][:10]
    note = f" {document['note']}" if "note" in document else ""
    return (
        f"*{machine['cores']} cores of {machine['cpu']}, torch {machine['torch']}, "
        f"commit {commit}{changed}, seed {document['seed']}, {day}.{note}*"
    )


# Bodies


def demo(document: Document) -> Lines:
    """Scores of the demo by group of views, and what was estimated."""
    run = document["results"][0]
    rows = []
    for name, scores in (run["groups"] | {"all": run["headline"]}).items():
        row = [name, str(scores["views"]), pair(scores, "psnr", "psnr_moving")]
        row += [number(scores["ssim"], 3), pair(scores, "mu5000", "mu5000_moving")]
        row += [pair(scores, "mu5000_recordable", "mu5000_recordable_moving")]
        rows.append(row)
    lines = table(["views", "number", "PSNR", "SSIM", "HDR", "HDR, recordable"], rows)
    camera, poses = run["camera"] or {}, run["poses"] or {}
    prepare = sum(seconds or 0 for seconds in run["prepare_seconds"].values())
    facts = [
        ["steps", f"{run['steps']:,}"],
        ["preparation, training, whole command",
         f"{prepare:.0f} s, {run['training_seconds']:.0f} s, {run['seconds']:.0f} s"],
        ["peak memory", f"{run['memory_gib']:.2f} GiB"],
        ["response RMSE", number(camera.get("response_rmse"), 4)],
        ["largest error of a step between exposures",
         f"{number(camera.get('largest_step_error'), 3)} EV"],
    ]  # fmt: skip
    for name in ("ate_share", "rotation_degrees", "focal_error"):
        facts.append([name.replace("_", " "), number(poses.get(name), 4)])
    return [*lines, "", *table(["quantity", "value"], facts)]


def bench_scores(document: Document) -> Lines:
    """PSNR and HDR of every method on every scene, and means."""
    runs = [run for run in document["results"] if run["status"] == "done"]
    scenes = list(dict.fromkeys(run["scene"] for run in runs))
    methods = list(dict.fromkeys(run["method"] for run in runs))
    found = {(run["scene"], run["method"]): run["values"] for run in runs}

    def cell(values: dict[str, float]) -> str:
        return f"{pair(values, 'psnr', 'psnr_moving')}, {number(values.get('mu5000'), 1)}"

    rows = []
    for scene in scenes:
        rows.append([f"`{scene}`", *(cell(found.get((scene, method), {})) for method in methods)])
    means = ["mean"]
    for method in methods:
        own = [found[scene, method] for scene in scenes if (scene, method) in found]
        means.append(cell(mean_of(own)))
    lines = [*table(["PSNR, HDR", *(f"`{method}`" for method in methods)], [*rows, means]), ""]
    steps = []
    for method in methods:
        counts = [found[scene, method]["steps"] for scene in scenes if (scene, method) in found]
        steps.append(f"`{method}` {min(counts):,.0f} to {max(counts):,.0f}")
    return [*lines, f"Steps: {', '.join(steps)}."]


def mean_of(runs: Sequence[dict[str, float]]) -> dict[str, float]:
    """The mean of every number that all runs have."""
    shared = set.intersection(*(set(values) for values in runs))
    return {key: statistics.fmean(values[key] for values in runs) for key in shared}


def bench_clips(document: Document) -> Lines:
    """One line per real clip: after equal steps, and both fields after equal time."""
    timed: dict[tuple[str, str], dict[str, float]] = {}
    path = RESULTS / f"{FIELDS}.json"
    if path.is_file():
        fields = json.loads(path.read_text())
        timed = {(run["scene"], run["method"]): run["values"] for run in fields["results"]}
    methods = list(dict.fromkeys(method for _, method in timed))
    rows = []
    for run in document["results"]:
        values = run["values"]
        row = [f"`{run['scene']}`", pair(values, "psnr", "psnr_moving")]
        row += [number(values.get("ssim"), 3)]
        for method in methods:
            row.append(pair(timed.get((run["scene"], method), {}), "psnr", "psnr_moving"))
        rows.append(row if run["status"] == "done" else [row[0], run["status"], "-", *row[3:]])
    steps = f"PSNR, {document['settings']['steps']} steps"
    if not timed:
        return table(["clip", steps, "SSIM"], rows)
    budget = fields["settings"]["budget"]
    heads = [f"`{method}`, {budget}" for method in methods]
    return [*table(["clip", steps, "SSIM", *heads], rows), "", f"{budget}: {origin(fields)}"]


def bench_rig(document: Document) -> Lines:
    """One line per scene: by estimated priors, by given ones, and between them."""
    found = {run["scene"]: run["values"] for run in document["results"]}
    rows = []
    for scene in (name.removesuffix("-frames") for name in found if name.endswith("-frames")):
        alone, given = found[f"{scene}-frames"], found[f"{scene}-given-oracle"]
        between = {key: given[key] - alone[key] for key in ("psnr", "psnr_moving")}
        cells = [pair(values, "psnr", "psnr_moving") for values in (alone, given, between)]
        rows.append([f"`{scene}`", *cells])
    heads = ["scene", "estimated priors", "given priors", "between"]
    small = json.loads((RESULTS / f"{RIG_POSES}.json").read_text())
    errors = {f"`{run['clip']}`": run for run in small["results"] if run["registered"] == 1}
    for row in rows:
        own = errors.get(row[0], {})
        row += [f"{100 * own[name]:.2f} %" if own else "-" for name in ("ate_share", "focal_error")]
    lines = table([*heads, "160x90: path error", "focal length"], rows)
    return [*lines, "", f"160x90: {origin(small)}"]


def exposure_steps(document: Document) -> Lines:
    """One line per clip: the largest errors of its steps, by what was recorded."""
    kinds = {"with noise": True, "without": False}
    results = document["results"]
    rows = []
    for clip in dict.fromkeys(run["clip"] for run in results if "noise" in run):
        row = [f"`{clip}`"]
        for noise in kinds.values():
            row.append(
                worst_step([r for r in results if (r["clip"], r.get("noise")) == (clip, noise)])
            )
        rows.append(row)
    filmed = [run for run in results if run.get("noise") is None]
    clips = len({run["clip"] for run in filmed})
    rows.append([f"{clips} clips as filmed", worst_step(filmed), "-"])
    return table(["re-exposed clip", *kinds], rows)


def worst_step(runs: Sequence[dict[str, Any]]) -> str:
    """The number of recordings and the largest error of a step among them."""
    if not runs:
        return "-"
    return f"{len(runs)}: {number(max(run['max_step_error'] for run in runs), 2)}"


def exposure_drift(document: Document) -> Lines:
    """One line per auto-exposed clip."""
    rows = []
    for clip in dict.fromkeys(run["clip"] for run in document["results"]):
        row = [clip]
        for lossless in (True, False):
            kind = (clip, lossless)
            run = next(r for r in document["results"] if (r["clip"], r["lossless"]) == kind)
            names = ("median_error", "error_95", "median_error_at_best_factor")
            row.append(" / ".join(number(run[name], 3) for name in names))
        rows.append(row)
    return table(["clip", "lossless frames", "compressed"], rows)


def bench_ablations(document: Document) -> Lines:
    """One line per ablation, one column per scene."""
    runs = [run for run in document["results"] if run["status"] == "done"]
    scenes = list(dict.fromkeys(run["scene"] for run in runs))
    found = {(run["scene"], run["method"]): run["values"] for run in runs}
    header = ["method"]
    for scene in scenes:
        header += [f"`{scene}` PSNR", "HDR", "response RMSE"]
    rows = []
    for method in dict.fromkeys(run["method"] for run in runs):
        row = [f"`{method}`"]
        for scene in scenes:
            values = found.get((scene, method), {})
            row.append(pair(values, "psnr", "psnr_moving"))
            row.append(pair(values, "mu5000", "mu5000_moving"))
            row.append(number(values.get("camera.response_rmse"), 3))
        rows.append(row)
    return table(header, rows)


def bench_convergence(document: Document) -> Lines:
    """One line per method, three columns per scene: scores at the end, PSNR during the
    run on a few views, and how long it was.
    """
    runs = {(run["scene"], run["method"]): run for run in document["results"]}
    scenes = list(dict.fromkeys(scene for scene, _ in runs))
    rows = []
    for method in dict.fromkeys(method for _, method in runs):
        row = [f"`{method}`"]
        for scene in scenes:
            run = runs[scene, method]
            values = run["values"]
            scores = pair(values, "psnr", "psnr_moving")
            rise = (number(point["scores"]["psnr"], 1) for point in run["curve"])
            minutes = number(values["train_seconds"] / 60, 0)
            row += [f"{scores}, {number(values.get('mu5000'), 1)}", ", ".join(rise)]
            row += [f"{values['steps']:,.0f} in {minutes} min"]
        rows.append(row)
    header = ["method"]
    for scene in scenes:
        header += [f"`{scene}` PSNR, HDR", "during the run", "steps"]
    return table(header, rows)


def bench_rise(document: Document) -> Lines:
    """One line per method: its scores, and PSNR during the run on a few views."""
    shares = [point["share"] for point in document["results"][0]["curve"]]
    rows = []
    for run in document["results"]:
        values = run["values"]
        row = [f"`{run['method']}`", pair(values, "psnr", "psnr_moving")]
        row += [number(values.get("ssim"), 3), pair(values, "mu5000", "mu5000_moving")]
        rise = {point["share"]: point["scores"]["psnr"] for point in run["curve"]}
        row += [number(rise.get(share), 1) for share in shares]
        minutes = values["train_seconds"] / 60
        rows.append([*row, number(values["steps"], 0), number(minutes, 0)])
    header = ["method", "PSNR", "SSIM", "HDR", *(f"after {share:.1%}" for share in shares)]
    return table([*header, "steps", "minutes"], rows)


def bench_scores_of_one(document: Document) -> Lines:
    """One line per method on a single scene."""
    rows = []
    for run in document["results"]:
        values = run["values"]
        row = [f"`{run['method']}`", pair(values, "psnr", "psnr_moving")]
        row += [number(values.get("ssim"), 3), pair(values, "mu5000", "mu5000_moving")]
        rows.append([*row, number(values.get("depth_abs_rel"), 3)])
    return table(["method", "PSNR", "SSIM", "HDR", "depth error"], rows)


def prepare_cost(document: Document) -> Lines:
    """One line per scene: processor seconds of the steps that cost most."""
    steps = ("all", "flow", "poses", "static_depth", "refined_flow", "movers")
    scenes = list(dict.fromkeys(row["scene"] for row in document["results"]))
    rows = []
    for scene in scenes:
        found = {row["step"]: row for row in document["results"] if row["scene"] == scene}
        size = f"{found['all']['frames']} of {found['all']['pixels']:,} pixels"
        seconds = [number(found[step]["cpu_seconds"], 0) for step in steps]
        rows.append([f"`{scene}`", size, *seconds, number(found["all"]["peak_memory_gb"], 2)])
    return table(["clip", "frames", *steps, "peak GB"], rows)


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
        "Two of these scenes until PSNR rises by less than 0.1 dB in the last fifth; `splat` and "
        "`grid` still rise on `interior`, `grid` on `lamp`. During the run: eight views after 1/8, "
        "1/4, 1/2, 4/5 and all of it, one thread each. No baseline reaches what `splat` has after "
        "an eighth, however long it trains. `splat` gains 0.9 dB on `interior` after that and "
        "loses 0.4 on `lamp`: priors limit it. HDR-HexPlane overfits `interior` from half of its "
        "run on; its published protocol, the left half of views, is not ours.",
        "hdr-nsff bench OUT --scenes SCENE --methods nerf-wt,hdr-hexplane,nsff,splat,grid --budget "
        "MINUTES --views 8",
        bench_convergence,
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
        "of the estimated masks. 2 minutes of training are on one thread, beside another run. "
        "`gopro` is the first 40 frames.",
        "hdr-nsff bench OUT --scenes CLIP,CLIP,... --methods splat --steps 800 --max-size 320 "
        "--views 0` and `--methods splat,grid --budget 2min --views 0 --jobs 2",
        bench_clips,
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
        "leave open.",
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
        "alternate contradict each other (published: 16 to 18 dB). Other programs ran on the other "
        "core.",
        "hdr-nsff synth interior interior --size 120x68 --spp 64 --truth-spp 64 --oracle && "
        "hdr-nsff bench OUT --scenes interior --oracle --methods "
        '"paper-small=paper-small --torch-threads 1,..."',
        bench_rise,
    ),
    Section(
        "bench-paper-small-ablations",
        "Ablations of the paper at that size",
        "The same scene in 1,000 steps, a twelfth of the run above: one part left out at a time. "
        "Responses come in the published order, one per image, fixed, none; but the paper loses "
        "5.5 dB by a fixed one, which here has the exact exposures. Flow and depth change little, "
        "which one run of each does not settle. Without the split, which the paper never leaves "
        "out, full pictures are worse and moving pixels better.",
        "hdr-nsff bench OUT --scenes interior --oracle --steps 1000 --views 0 --methods "
        '"paper-small=paper-small --torch-threads 1,..."',
        bench_scores_of_one,
    ),
    Section(
        "prepare",
        "What preparing a clip costs",
        "Processor seconds of the steps that cost most, and the peak memory of the process. "
        "`sports` is the demo clip of the package `sports2d`, re-exposed at 640x360; it took 7 "
        "minutes in all.",
        "python benchmarks/cost.py SCENE ... --prepare --out benchmarks/results/prepare.json",
        prepare_cost,
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
