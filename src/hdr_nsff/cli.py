"""The command line: one verb, one function, one config. Bad input is one sentence and
exit code 2.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

try:
    import tyro

    from hdr_nsff import __version__
    from hdr_nsff.bench.bench import BenchConfig, bench
    from hdr_nsff.core.errors import InputError
    from hdr_nsff.core.io import writing_to
    from hdr_nsff.core.progress import say
    from hdr_nsff.evaluation.evaluate import EvaluateConfig, evaluate
    from hdr_nsff.evaluation.report import ReportConfig, report
    from hdr_nsff.flow_training.finetune_flow import FinetuneConfig, finetune_flow
    from hdr_nsff.pipeline import RunConfig, run_all
    from hdr_nsff.prepare.prepare import PrepareConfig, prepare
    from hdr_nsff.prepare.weights import WeightsConfig, weights
    from hdr_nsff.rendering.export import ExportConfig, export
    from hdr_nsff.rendering.render import RenderConfig, render
    from hdr_nsff.synth.reexpose import ReexposeConfig, reexpose
    from hdr_nsff.synth.synth import SynthConfig, synth
    from hdr_nsff.training.config import ABLATIONS, PRESETS, TrainConfig
    from hdr_nsff.training.train import train
except KeyboardInterrupt:  # while the libraries load, which takes seconds
    raise SystemExit(130) from None


@dataclass(frozen=True)
class Verb:
    """What a word on the command line does."""

    act: Callable[[Any], Any]
    config: Any  # a config dataclass, or {preset name: default config}
    summary: str


VERBS = {
    "run": Verb(
        run_all, RunConfig, "Footage to HDR in one go: prepare, train, render, evaluate, report."
    ),
    "prepare": Verb(
        prepare, PrepareConfig, "Footage to a scene folder: exposures, poses, flow, masks, depth."
    ),
    "train": Verb(
        train,
        PRESETS,
        "Train a radiance field from a scene folder: `train splat`, `train grid`, ...; `train --help` lists the presets.",
    ),
    "render": Verb(
        render,
        RenderConfig,
        "Views of a trained run: EXR, PNG, video; any path, time and exposure.",
    ),
    "export": Verb(
        export,
        ExportConfig,
        "For other programs: a splat run's Gaussians as PLY, or a scene in a public data layout.",
    ),
    "evaluate": Verb(evaluate, EvaluateConfig, "Measure a trained run on held-out views."),
    "report": Verb(
        report,
        ReportConfig,
        "One HTML page about a run: pictures, curves, losses, metrics, what was given.",
    ),
    "bench": Verb(
        bench, BenchConfig, "Methods x scenes in one table: trained, measured, side by side."
    ),
    "synth": Verb(
        synth,
        SynthConfig,
        "Path-trace a scene with exact truth, recorded in alternating exposures.",
    ),
    "finetune-flow": Verb(
        finetune_flow,
        FinetuneConfig,
        "Adapt a flow network to pairs of different exposure, for `prepare --flow raft-finetuned`.",
    ),
    "reexpose": Verb(
        reexpose, ReexposeConfig, "Make an alternating-exposure problem of any ordinary clip."
    ),
    "weights": Verb(
        weights,
        WeightsConfig,
        "List the networks that can help, whether their weights are here, how to get them.",
    ),
}
PRESET_HELP = {
    "splat": "4D Gaussians, minutes on a CPU, tens of small frames a second; the default of `run`.",
    "grid": "A scene flow field on additive grids, minutes on a CPU.",
    "paper": "The published network, losses and schedules; hours on a GPU.",
    "tiny": "Seconds on a CPU, to try things out.",
    "nsff": "Baseline: NSFF, which knows one exposure, on the grids of `grid`.",
    "nsff-paper": "Baseline: NSFF at its published size, for a GPU.",
    "nerf-wt": "Baseline: NeRF-W with time, a code per image instead of a tone mapper, on the grids of `grid`.",
    "nerf-wt-paper": "Baseline: the same at its published size, for a GPU.",
    "hdr-hexplane": "Baseline: HDR-HexPlane, tone-mapped sample by sample, small enough for a CPU.",
    "hdr-hexplane-paper": "Baseline: the same at its published size, for a GPU.",
}
MORE_PRESETS = (
    f"Ablations of ours: `grid-NAME` and `splat-NAME` with NAME one of {', '.join(ABLATIONS)} (no-saturation of `grid` alone); "
    "docs/baselines.md says what each is."
)


def usage() -> str:
    """What `hdr-nsff --help` prints."""
    lines = [f"  {name:<13} {verb.summary}" for name, verb in VERBS.items()]
    tail = "`hdr-nsff VERB --help` explains a verb; `hdr-nsff VERB --tyro-print-completion bash` prints its shell completion."
    return "\n".join(
        [
            "usage: hdr-nsff [--version] VERB ...",
            "",
            "Alternating-exposure footage in, dynamic HDR radiance field out.",
            "",
            *lines,
            "",
            tail,
        ]
    )


def parse(verb: Verb, name: str, arguments: Sequence[str]) -> Any:
    """The config of a verb from its arguments; tyro prints help and typos itself and
    exits.
    """
    if isinstance(verb.config, dict):
        asked = arguments[0] if arguments else ""
        shown = (
            {asked: f"Ablation: `{asked}`."}
            if asked in verb.config and asked not in PRESET_HELP
            else PRESET_HELP
        )
        presets = {k: (words, verb.config[k]) for k, words in shown.items()}
        about = f"{TrainConfig.__doc__} {MORE_PRESETS}"
        config = tyro.extras.overridable_config_cli(
            presets, prog=f"hdr-nsff {name}", description=about, args=arguments
        )
        assert isinstance(config, TrainConfig)
        return config
    return tyro.cli(
        verb.config,
        prog=f"hdr-nsff {name}",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb; exits with 0, 1 (a run of `bench` failed), 2 (bad input) or 130
    (Ctrl-C).
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments[:1] == ["--version"]:
        print(f"hdr-nsff {__version__}")
        return
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        raise SystemExit(0 if arguments else 2)
    if arguments[0] not in VERBS:
        fail(f"no verb {arguments[0]!r}; there are {', '.join(VERBS)}")
    verb = VERBS[arguments[0]]
    if foreign := next((a for a in arguments if a.encode(errors="ignore").decode() != a), None):
        fail(f"{foreign!r}: a name that is no UTF-8 text; rename the file or folder")
    try:
        with writing_to("output"):
            verb.act(parse(verb, arguments[0], arguments[1:]))
    except InputError as error:
        fail(str(error))
    except KeyboardInterrupt:
        say("stopped; the same command goes on where it was")
        raise SystemExit(130) from None


def fail(message: str) -> None:
    """Print one sentence and exit with code 2."""
    print(f"hdr-nsff: {' '.join(message.splitlines())}", file=sys.stderr)
    raise SystemExit(2)
