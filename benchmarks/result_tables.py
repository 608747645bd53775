"""The tables of docs/results.md, each from one JSON file of benchmarks/results/."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from typing import Any

from markdown_tables import Lines, number, pair, table
from record import RESULTS

Document = dict[str, Any]
FIELDS = "bench-fields"  # both fields on real clips, in equal time
RIG_POSES = "rig-poses"  # priors of rigs at 160x90, by `priors.py`


def origin(document: Document) -> str:
    """The machine, commit and seed of a file, in a line."""
    machine = document["machine"]
    trained = dict.fromkeys(run["commit"] for run in document["results"] if run.get("commit"))
    commits = list(trained) or document.get("commits") or [document["commit"] or "unknown"]
    commit = ", ".join(shown_commit(name) for name in commits)
    changed = ", with changes" if document["dirty"] and not trained else ""
    day = document["date"][:10]
    note = f" {document['note']}" if "note" in document else ""
    return (
        f"*{machine['cores']} cores of {machine['cpu']}, torch {machine['torch']}, "
        f"commit {commit}{changed}, seed {document['seed']}, {day}.{note}*"
    )


def shown_commit(name: str) -> str:
    """A commit in nine letters, and whether files of the program had changed."""
    return name[:9] + (" with changes" if name.endswith("-dirty") else "")


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
    facts = {
        "steps": f"{run['steps']:,}",
        "preparation, training, all": f"{prepare:.0f} s, {run['training_seconds']:.0f} s, "
        f"{run['seconds']:.0f} s",
        "memory": f"{run['memory_gib']:.2f} GiB",
        "response RMSE": number(camera.get("response_rmse"), 4),
        "largest error of a step": f"{number(camera.get('largest_step_error'), 3)} EV",
    }
    for name in ("ate_share", "rotation_degrees", "focal_error"):
        facts[name.replace("_", " ")] = number(poses.get(name), 4)
    return [*lines, "", *table(list(facts), [list(facts.values())])]


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


# Of every effect: the run without its model and the run with it, each as the end of
# its scene's name and its method.
LENS_MODELS = {
    "vignetted": (("", "no-vignetting"), ("", "splat")),
    "rolling": (("", "splat"), ("-readout", "splat")),
    "blurred": (("", "splat"), ("", "shutter")),
    "bent": (("-pinhole", "splat"), ("", "splat")),
}


def bench_lenses(document: Document) -> Lines:
    """One line per effect of a lens or shutter: PSNR without its model and with it, on
    clips with the effect and without, and the ratio of training times on the latter.
    """
    runs = document["results"]
    names = [run["scene"] for run in runs if run["scene"].endswith("-plain")]
    scenes = list(dict.fromkeys(name.removesuffix("-plain") for name in names))
    rows = []
    for kind, models in LENS_MODELS.items():
        row, ratios = [kind], []
        for scene in scenes:
            for recorded in (kind, "plain"):
                places = [(f"{scene}-{recorded}{name}", method) for name, method in models]
                ends = of_one_program(runs, places)
                row.append(" → ".join(pair(values, "psnr", "psnr_moving") for values in ends))
                if recorded == "plain":
                    ratios.append(ends[1]["train_seconds"] / ends[0]["train_seconds"])
        rows.append([*row, number(statistics.fmean(ratios), 2)])
    heads = [f"`{scene}`{end}" for scene in scenes for end in (" with it", " without it")]
    return table(["effect", *heads, "training time"], rows)


def of_one_program(
    runs: Sequence[dict[str, Any]], places: Sequence[tuple[str, str]]
) -> list[dict[str, float]]:
    """The numbers of the latest runs at `places` (scene, method) that one commit
    trained with as many threads: the times of others cannot be compared.
    """
    found: dict[tuple[str, int], dict[tuple[str, str], dict[str, float]]] = {}
    for run in runs:
        own = found.setdefault((run["commit"], run["threads"]), {})
        own[run["scene"], run["method"]] = run["values"]
    whole = [own for own in found.values() if own.keys() >= set(places)]
    return [whole[-1][place] for place in places]


def bench_movers(document: Document) -> Lines:
    """One line per clip, and their means: both methods, on movers too."""
    runs = {(run["scene"], run["method"]): run["values"] for run in document["results"]}
    keys = ("psnr", "psnr_moving", "stability.hdr_tae_moving")
    scenes = list(dict.fromkeys(scene for scene, _ in runs))
    methods = list(dict.fromkeys(method for _, method in runs))
    for method in methods:
        of_all = [runs[scene, method] for scene in scenes]
        means = {key: sum(values[key] for values in of_all) / len(of_all) for key in keys}
        runs["mean", method] = means
    rows = []
    for scene in [*scenes, "mean"]:
        row = [scene if scene == "mean" else f"`{scene}`"]
        for method in methods:
            values = runs[scene, method]
            row += [pair(values, *keys[:2]), number(values[keys[2]], 3)]
        rows.append(row)
    heads = [head for method in methods for head in (f"`{method}`", "HDR-TAE of movers")]
    return table(["clip", *heads], rows)


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
    """One line per run: its scores, and PSNR during the run where views were kept."""
    shares = [point["share"] for point in document["results"][0]["curve"]]
    several = len({run["scene"] for run in document["results"]}) > 1
    rows = []
    for run in document["results"]:
        values = run["values"]
        name = f"`{run['method']}`" + (f", `{run['scene']}`" if several else "")
        row = [name, pair(values, "psnr", "psnr_moving")]
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


# What the cost of every step of `prepare` grows with.
GROWS_WITH = {
    "frames": "frames, pixels",
    "exposure": "frames; pictures are shrunk",
    "flow": "frames (a few pairs each), pixels",
    "poses": "frames; keypoints of the pixels; with parallax, and once more where masks change",
    "masks": "frames, pixels of a grid of bounded size; rounds of poses",
    "static_depth": "frames, pixels, planes; nothing without parallax",
    "response": "frames, pixels of what is well seen",
    "refined_flow": "pairs, moving pixels",
    "movers": "tracks, which start in every frame where something moves",
    "depth": "frames, pixels",
    "sheet": "-",
}


def prepare_cost(document: Document) -> Lines:
    """One line per step: processor seconds per megapixel and frame of every clip, and
    what they grow with; and of all steps.
    """
    found = {(row["scene"], row["step"]): row for row in document["results"]}
    scenes = list(dict.fromkeys(scene for scene, _ in found))
    rows = []
    for step, growth in GROWS_WITH.items():
        costs = [found[scene, step]["cpu_seconds_per_megapixel"] for scene in scenes]
        rows.append([f"`{step}`", *(number(cost, 2) for cost in costs), growth])
    every = [found[scene, "all"] for scene in scenes]
    costs = [number(row["cpu_seconds_per_megapixel"], 2) for row in every]
    rows.append(["all", *costs, "frames, pixels"])
    for label, key in (("all, processor minutes", "cpu_seconds"), ("all, minutes", "seconds")):
        rows.append([label, *(number(row[key] / 60, 1) for row in every), ""])
    rows.append(["peak GB", *(number(row["peak_memory_gb"], 2) for row in every), "pixels"])
    sizes = [f"`{row['scene']}` ({row['frames']} x {row['pixels']:,})" for row in every]
    return table(["step", *sizes, "grows with"], rows)


def training_speed(document: Document) -> Lines:
    """Steps a second and peak memory of every preset on every clip."""
    rows = []
    for row in document["results"]:
        clip = f"`{row['scene']}` ({row['frames']} x {row['pixels']:,})"
        numbers = number(row["steps_per_second"], 1), number(row["peak_memory_gb"], 2)
        rows.append([clip, f"`{row['preset']}`", *numbers])
    return table(["clip", "preset", "steps a second", "peak GB"], rows)
