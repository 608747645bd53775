"""The command line: one verb, one function, one config. Bad input is one sentence and
exit code 2.

The table of verbs is plain text. A verb's module, and with it torch and its relatives,
is imported when the verb is called, so `hdr-nsff --help` answers at once.
"""

from __future__ import annotations

try:
    import os
    import sys
    from collections.abc import Iterator, Sequence
    from contextlib import AbstractContextManager, contextmanager, nullcontext
    from dataclasses import dataclass
    from functools import partial
    from importlib import import_module
    from typing import Any, NoReturn

    from hdr_nsff import __version__
    from hdr_nsff.core.errors import InputError
    from hdr_nsff.core.process import prepare_process
except KeyboardInterrupt:  # Ctrl-C before `main` is reached
    raise SystemExit(130) from None

INTERRUPTED = 130  # exit code by convention: 128 + SIGINT
CLOSED_PIPE = 141  # 128 + SIGPIPE
VIEW = "--view"  # of `train`: show the field in the browser while it trains
LOADING = "loading libraries ..."
SILENT_SECONDS = 0.7  # without a word, of a verb that is called on a terminal
MAX_MESSAGE = 560  # characters of a sentence about bad input


@dataclass(frozen=True)
class Verb:
    """A word on the command line."""

    function: str  # place of what it does, as in "package.module:name"
    config: str | None  # of a dataclass or {preset: default config}; None: no options
    summary: str


VERBS = {
    "run": Verb(
        "hdr_nsff.pipeline:run_all",
        "hdr_nsff.pipeline:RunConfig",
        "Footage to HDR in one go: prepare, train, render, evaluate, report.",
    ),
    "check": Verb(
        "hdr_nsff.check.check:check",
        "hdr_nsff.check.check:CheckConfig",
        "Look at a clip in a minute: what will work, what to shoot otherwise.",
    ),
    "prepare": Verb(
        "hdr_nsff.prepare.prepare:prepare",
        "hdr_nsff.prepare.prepare:PrepareConfig",
        "Turn footage into a scene folder: exposures, poses, flow, masks, depth.",
    ),
    "train": Verb(
        "hdr_nsff.training.train:train",
        "hdr_nsff.training.presets:PRESETS",
        "Train a radiance field from a scene folder; `train --help` lists the presets.",
    ),
    "render": Verb(
        "hdr_nsff.rendering.render:render",
        "hdr_nsff.rendering.render:RenderConfig",
        "Render views of a trained run: EXR, PNG, video; any path, time and exposure.",
    ),
    "view": Verb(
        "hdr_nsff.view:view",
        "hdr_nsff.view:ViewConfig",
        "Look around in a trained run, in the browser.",
    ),
    "export": Verb(
        "hdr_nsff.rendering.export:export",
        "hdr_nsff.rendering.export:ExportConfig",
        "Write a page that plays the run, Gaussians as PLY, or a public data layout.",
    ),
    "evaluate": Verb(
        "hdr_nsff.evaluation.evaluate:evaluate",
        "hdr_nsff.evaluation.evaluate:EvaluateConfig",
        "Measure a trained run on held-out views.",
    ),
    "report": Verb(
        "hdr_nsff.evaluation.report:report",
        "hdr_nsff.evaluation.report:ReportConfig",
        "Write one HTML page about a run: pictures, curves, losses, metrics, inputs.",
    ),
    "bench": Verb(
        "hdr_nsff.bench.bench:bench",
        "hdr_nsff.bench.bench:BenchConfig",
        "Train and measure methods on scenes, side by side in one table.",
    ),
    "synth": Verb(
        "hdr_nsff.synth.synth:synth",
        "hdr_nsff.synth.synth:SynthConfig",
        "Path-trace a scene with exact truth, recorded in alternating exposures.",
    ),
    "finetune-flow": Verb(
        "hdr_nsff.flow_training.finetune_flow:finetune_flow",
        "hdr_nsff.flow_training.finetune_flow:FinetuneConfig",
        "Adapt a flow network to pairs of different exposure.",
    ),
    "reexpose": Verb(
        "hdr_nsff.synth.reexpose:reexpose",
        "hdr_nsff.synth.reexpose:ReexposeConfig",
        "Make an alternating-exposure problem of any ordinary clip.",
    ),
    "weights": Verb(
        "hdr_nsff.prepare.weights:weights",
        "hdr_nsff.prepare.weights:WeightsConfig",
        "List the networks that can help, and where their weights are.",
    ),
    "doctor": Verb(
        "hdr_nsff.doctor:doctor",
        None,
        "Describe this installation, for a bug report; say what is missing.",
    ),
}

PRESET_HELP = {
    "splat": "4D Gaussians: minutes on a CPU; the default of `run`.",
    "grid": "A scene flow field on additive grids: minutes on a CPU.",
    "paper": "The published network, losses and schedules: 250,000 steps, for a GPU.",
    "paper-small": "The same, small enough for 42 minutes on a CPU core with bfloat16 at 120x68.",
    "tiny": "Seconds on a CPU, to try things out.",
    "nsff": "Baseline: NSFF, which knows one exposure, on the grids of `grid`.",
    "nsff-paper": "Baseline: NSFF at its published size, for a GPU.",
    "nsff-paper-small": "Baseline: the same as small as `paper-small`.",
    "nerf-wt": "Baseline: NeRF-W with time on the grids of `grid`; it learns a code per image "
    "instead of a tone mapper.",
    "nerf-wt-paper": "Baseline: NeRF-W with time at its published size, for a GPU.",
    "nerf-wt-paper-small": "Baseline: the same as small as `paper-small`.",
    "hdr-hexplane": "Baseline: HDR-HexPlane, tone-mapped sample by sample, small enough for a CPU.",
    "hdr-hexplane-paper": "Baseline: HDR-HexPlane at its published size, for a GPU.",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one verb. Exits with 0, 1 (a run of `bench` failed, or `doctor` found
    something missing), 2 (bad input), 130 (Ctrl-C) or 141 (the reader of the output has
    gone).
    """
    try:
        try:
            call(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()  # a closed pipe shows here, not at the interpreter's exit
    except BrokenPipeError:
        silence_stdout()
        raise SystemExit(CLOSED_PIPE) from None
    except KeyboardInterrupt:  # before the verb has begun
        raise SystemExit(INTERRUPTED) from None


def call(arguments: list[str]) -> None:
    """Answer `--version` and `--help`, or run the verb that is named first."""
    if arguments[:1] == ["--version"]:
        print(f"hdr-nsff {__version__}")
        return
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        raise SystemExit(0 if arguments else 2)
    for argument in arguments:
        if not is_text(argument):
            fail(f"{argument!r}: a name that is not UTF-8 text; rename the file or folder")
    name, options = arguments[0], arguments[1:]
    if name not in VERBS:
        fail(unknown_verb(name))
    run_verb(name, VERBS[name], options)


def run_verb(name: str, verb: Verb, options: list[str]) -> None:
    """Import a verb, read its options and call it."""
    prepare_process()
    if verb.config is None:
        refuse_options(name, verb, options)
        load(verb.function)()
        return
    with loading():
        function, config = load(verb.function), load(verb.config)
        from hdr_nsff.core.io import writing_to

    with_viewer = name == "train" and VIEW in options
    try:
        settings = parse(name, config, [o for o in options if not (with_viewer and o == VIEW)])
        viewer: AbstractContextManager[None] = nullcontext()
        if with_viewer:
            settings = load("hdr_nsff.view:watched")(settings, options)
            viewer = load("hdr_nsff.view:viewer_beside")(settings.out)
        with writing_to("output"), viewer:
            function(settings)
    except InputError as error:
        fail(str(error))
    except KeyboardInterrupt:
        stop()
    except Exception as error:
        if "KeyboardInterrupt" not in str(error):  # pydantic's core wraps one in its own
            raise
        stop()


@contextmanager
def loading(seconds: float = SILENT_SECONDS) -> Iterator[None]:
    """A line on the terminal while libraries are imported, where that takes longer than
    `seconds`; it is erased afterwards.
    """
    if not sys.stderr.isatty():
        yield
        return
    from threading import Timer

    written: list[str] = []

    def write(text: str) -> None:
        written.append(text)
        print(text, end="", file=sys.stderr, flush=True)

    timer = Timer(seconds, write, [LOADING])
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()
        if written:
            write(f"\r{' ' * len(LOADING)}\r")


def stop() -> NoReturn:
    """Say that Ctrl-C was heard, and exit."""
    print("hdr-nsff: stopped; the same command continues where it was", file=sys.stderr)
    raise SystemExit(INTERRUPTED) from None


def load(place: str) -> Any:
    """The object at a place such as "package.module:name". A library that cannot be
    imported is one sentence.
    """
    module, _, name = place.partition(":")
    try:
        return getattr(import_module(module), name)
    except ImportError as error:
        if (error.name or "").partition(".")[0] == __package__:
            raise  # a fault of this package
        fail(f"{error}; `hdr-nsff doctor` lists what is missing and how to get it")


def parse(name: str, config: Any, options: Sequence[str]) -> Any:
    """The config of a verb from its options. tyro prints help and exits.

    InputError where it refuses them.
    """
    from hdr_nsff.core.refusals import Command, refusals_as_sentences, unknown

    start: list[str] = []
    if isinstance(config, dict):
        check_preset(name, config, options)
        start = [option for option in options[:1] if option in config]
    read = partial(parse_options, name, config)
    words = " ".join(["hdr-nsff", name, *start])
    command = Command(words, options, partial(read, [*start, "--help"]), partial(elsewhere, name))
    if any(option.replace("_", "-").startswith("--tyro-") for option in options[:1]):
        raise InputError(unknown(options, command))  # its completion takes over other commands
    with refusals_as_sentences(command):
        return read(options)


def parse_options(name: str, config: Any, options: Sequence[str]) -> Any:
    """The same in tyro's words: what it refuses is a box and exit code 2."""
    import tyro

    if isinstance(config, dict):
        return parse_preset(name, config, options)
    return tyro.cli(
        config,
        prog=f"hdr-nsff {name}",
        args=options,
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )


def elsewhere(name: str, option: str, value: str) -> str:
    """Where a preset can be found that `run` lacks."""
    if (name, option) == ("run", "--preset") and value in PRESET_HELP:
        return f" (`hdr-nsff train {value} --scene OUT/scene` has it)"
    return ""


def check_preset(name: str, presets: dict[str, Any], options: Sequence[str]) -> None:
    """InputError unless a preset, or a request for help, stands first."""
    from hdr_nsff.core.errors import shorten
    from hdr_nsff.core.refusals import did_you_mean

    first = options[0] if options else ""
    if first in presets or first == "-h" or first.startswith("--help"):
        return
    listed = f"the presets are {', '.join(PRESET_HELP)}"
    if not first or first.startswith("-"):
        raise InputError(f"{name}: name a preset first, as in `hdr-nsff {name} splat`; {listed}")
    hint = did_you_mean(first, presets)
    raise InputError(f"no preset {shorten(first)!r}{hint}; {listed}")


def parse_preset(name: str, presets: dict[str, Any], options: Sequence[str]) -> Any:
    """The config of `train`: a preset, with some of its settings replaced. Ablations
    are named in a sentence instead of a line each; one is listed where it is asked for.
    """
    import inspect

    import tyro

    from hdr_nsff.training.config import TrainConfig
    from hdr_nsff.training.presets import ABLATIONS, OF_PAPER_SMALL

    shown = PRESET_HELP
    if options and options[0] in presets and options[0] not in PRESET_HELP:
        shown = {options[0]: f"Ablation: `{options[0]}`."}
    about = (
        f"{inspect.getdoc(TrainConfig)} Ablations of ours: `grid-NAME` and `splat-NAME` with NAME "
        f"one of {', '.join(ABLATIONS)} (no-saturation of `grid` alone), and "
        f"`paper-small-NAME` with {', '.join(OF_PAPER_SMALL)}; docs/baselines.md "
        f"describes them. `{VIEW}` shows the field in the browser while it trains."
    )
    return tyro.extras.overridable_config_cli(
        {preset: (text, presets[preset]) for preset, text in shown.items()},
        prog=f"hdr-nsff {name}",
        description=about,
        args=options,
    )


def refuse_options(name: str, verb: Verb, options: Sequence[str]) -> None:
    """Help and errors of a verb without options, which needs no library."""
    import argparse

    parser = argparse.ArgumentParser(f"hdr-nsff {name}", description=verb.summary)
    superfluous = parser.parse_known_args(options)[1]
    if superfluous:
        fail(f"{superfluous[0]!r:.60}: `{name}` takes no arguments; leave it out")


def usage() -> str:
    """What `hdr-nsff --help` prints."""
    lines = [
        "usage: hdr-nsff [--version] VERB ...",
        "",
        "Alternating-exposure footage in, dynamic HDR radiance field out.",
        "",
        *(f"  {name:<13} {verb.summary}" for name, verb in VERBS.items()),
        "",
        "`hdr-nsff VERB --help` explains a verb.",
    ]
    return "\n".join(lines)


def unknown_verb(name: str) -> str:
    """A sentence with the verb that was probably meant and all that exist."""
    import difflib

    similar = difflib.get_close_matches(name, VERBS, n=1)
    verbs = ", ".join(VERBS)
    if similar:
        return f"no verb {name!r:.60}; did you mean {similar[0]}? The verbs are {verbs}"
    return f"no verb {name!r:.60}; the verbs are {verbs}"


def is_text(argument: str) -> bool:
    """Whether an argument is valid UTF-8: the bytes of other names arrive as lone
    surrogates.
    """
    try:
        argument.encode()
    except UnicodeEncodeError:
        return False
    return True


def fail(message: str) -> NoReturn:
    """Print one sentence and exit with code 2. Where the input makes it very long, its
    middle is left out.
    """
    sentence = " ".join(message.splitlines())
    if len(sentence) > MAX_MESSAGE:
        half = MAX_MESSAGE // 2
        sentence = f"{sentence[:half]} ... {sentence[-half:]}"
    print(f"hdr-nsff: {sentence}", file=sys.stderr)
    raise SystemExit(2)


def silence_stdout() -> None:
    """Send what is left in stdout's buffer nowhere, so that Python does not complain of
    the closed pipe at its exit.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
