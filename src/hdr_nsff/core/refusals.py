"""What the parser of the command line refuses, as one sentence instead of a box.

tyro hands a refusal to a hook, which is no public interface of it. Where a version
lacks the hook, or refuses for a reason unknown here, its box becomes the sentence.
"""

from __future__ import annotations

import difflib
import importlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from io import StringIO
from typing import Any

from hdr_nsff.core.errors import InputError, shorten

FLAG = re.compile(r"--[a-z][a-z0-9.-]*")
BOX = re.compile("[\u2500-\u257f]+")  # box-drawing characters
PLACES = ("--scene", "--out", "--truth", "--renders")  # options for files and folders
MAY_BE_LEFT_OUT = "{None}|"  # in tyro's name of a type
TYPES = {"INT": "not a whole number", "FLOAT": "not a number", "STR STR": "not two values"}


@dataclass(frozen=True)
class Command:
    """A verb, and the options that it was called with."""

    name: str  # as typed: "hdr-nsff train splat"
    options: Sequence[str]
    print_help: Callable[[], Any]  # prints all options that the verb has
    # where a choice that an option lacks can be found; "" where nowhere
    elsewhere: Callable[[str, str], str] = lambda option, value: ""

    @property
    def help(self) -> str:
        """What explains its options."""
        return f"`{self.name} --help`"

    def flags(self) -> list[str]:
        """All options that the verb has."""
        text = StringIO()
        with redirect_stdout(text), suppress(SystemExit):
            self.print_help()
        return sorted(set(FLAG.findall(text.getvalue())) - {"--help"})


@contextmanager
def refusals_as_sentences(command: Command) -> Iterator[None]:
    """InputError instead of a box and exit code 2 while tyro parses."""

    def refuse(event: Any) -> None:
        sentence = describe(event, command)
        if sentence:
            raise InputError(sentence)

    printed = StringIO()
    try:
        with redirect_stderr(printed), hook(refuse):
            yield
    except SystemExit as stop:
        if stop.code != 2:
            raise
        raise InputError(" ".join(BOX.sub(" ", printed.getvalue()).split())) from stop
    sys.stderr.write(printed.getvalue())


def hook(refuse: Callable[[Any], None]) -> Any:
    """The context in which tyro calls `refuse`; without effect where it cannot."""
    try:
        register = importlib.import_module("tyro._errors").on_parse_error
    except (ImportError, AttributeError):
        return nullcontext()
    return register(refuse)


def describe(event: Any, command: Command) -> str:
    """The sentence for a refusal; "" for one of an unknown kind."""
    match type(event).__name__:
        case "InvalidChoice":
            option, value = name_of(event.argument), event.value
            hint = command.elsewhere(option, value) or did_you_mean(value, event.choices)
            choices = list(event.choices)
            if "None" in choices:  # the option may be left out: tyro keeps no order then
                choices = sorted(set(choices) - {"None"})
            listed = ", ".join(choices)
            return f"{option} {shorten(value)}: no such choice{hint}; choose one of {listed}"
        case "InstantiationFailure" if event.argument is not None:
            option, problem = name_of(event.argument), problem_of(event.argument)
            value = shorten(value_of(option, command.options))
            given = f"{option} {value}".strip()
            return f"{given}: {problem}; {command.help} explains the option"
        case "BadValue" if event.reason == "too_few_values":
            option = name_of(event.argument)
            return f"{option}: no value follows; {command.help} explains what it takes"
        case "UnrecognizedArgs":
            return unknown(event.tokens, command)
        case "MissingArgs":
            if any(is_option(token) for token in event.unrecognized_tokens):
                return unknown(event.unrecognized_tokens, command)
            *others, last = [name_of(missing.arg) for missing in event.missing_arguments]
            if others:
                return f"{', '.join(others)} and {last} are missing; {command.help} explains them"
            return f"{last} is missing; {command.help} explains it"
    return ""


def unknown(words: Sequence[str], command: Command) -> str:
    """The sentence for words of a command that mean nothing to its verb."""
    for word in words:
        if is_option(word):
            option = word.partition("=")[0]
            hint = did_you_mean(option, command.flags())
            return f"{shorten(option)}: no such option{hint}; {command.help} lists all"
    word = words[0]
    place = list(command.options).index(word) if word in command.options else 0
    before = command.options[place - 1] if place > 0 else ""
    if is_option(before):
        return f"{before} {shorten(word)}: the option takes no value; leave {shorten(word)!r} out"
    named = [flag for flag in command.flags() if flag in PLACES]
    advice = f"name it by its option ({', '.join(named)}), " if named else ""
    return (
        f"{shorten(word)!r}: one argument too many; {advice}leave it out, or quote a name that "
        f"has spaces; {command.help} lists all"
    )


def is_option(word: str) -> bool:
    """Whether a word of a command is the name of an option, not a negative number."""
    return re.match(r"--?[a-zA-Z]", word) is not None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint at the known word that is most like a wrong one; "" where none is."""
    similar = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {similar[0]}?)" if similar else ""


def name_of(argument: Any) -> str:
    """An argument as users know it: --option, or the NAME of one without."""
    if argument.is_positional():
        return str(argument.field.intern_name).upper()
    return str(argument.lowered.name_or_flags[0])


def problem_of(argument: Any) -> str:
    """What is wrong with a value that has not the type of its argument."""
    name = str(argument.lowered.metavar).removeprefix(MAY_BE_LEFT_OUT).strip("{}")
    return TYPES.get(name, "not what it takes")


def value_of(option: str, words: Sequence[str]) -> str:
    """The value that follows an option on the command line; "" where none is found."""
    for word, following in zip(words, [*words[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            return value if equals else following
    return ""
