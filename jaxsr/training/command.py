"""`jaxsr train METHOD`: the options of a training, of a method and of its loss, as one command line."""

import dataclasses
import sys
from collections.abc import Collection, Sequence
from typing import Annotated, Any

import tyro

from jaxsr.errors import JaxsrError
from jaxsr.methods import LEARNED, Learned
from jaxsr.training.config import TrainConfig
from jaxsr.training.loop import train

DESCRIPTION = """Train the network of a method. The same command resumes a training that was stopped.

The options are the fields of three dataclasses: of the training (jaxsr.training.TrainConfig), of the network
and of its loss."""


def run(arguments: Sequence[str], learned: dict[str, Learned] | None = None) -> None:
    """Train as the arguments after `jaxsr train` say.

    Args:
        arguments: the method's name, then options.
        learned: methods by name; `jaxsr.methods.LEARNED` by default.

    Raises:
        JaxsrError: no such method, and what `train` raises.
        SystemExit: bad syntax, or help was asked for.
    """
    learned = LEARNED if learned is None else learned
    name, *rest = arguments or [""]
    if name in ("-h", "--help"):
        print(f"usage: jaxsr train {{{','.join(learned)}}} [options]\n\n{DESCRIPTION}\n")
        print(f"`jaxsr train {next(iter(learned))} --help` lists the options.")
        return
    if name not in learned:
        raise JaxsrError(
            f"no method {name!r} that learns" if name else "no method to train",
            where="jaxsr train",
            expected=f"one of {', '.join(learned)}",
            fix="name it before the options",
        )
    options, loss = learned[name].options, learned[name].loss
    has_scale = any(field.name == "scale" for field in dataclasses.fields(options))
    groups = [
        ("training", TrainConfig, TrainConfig()),
        ("method", (offered := _without_groups(options)), offered()),
        ("loss", loss, loss()),
    ]
    chosen: Any = tyro.cli(
        dataclasses.make_dataclass("TrainingAndMethod", groups),
        args=_joined("--init", _renamed(rest, {field.name for field in dataclasses.fields(options)})),
        prog=f"jaxsr train {name}",
        description=DESCRIPTION,
        config=(tyro.conf.OmitArgPrefixes,),
    )
    config, given = chosen.training, vars(chosen.method)
    settings = options(**given | ({"scale": config.scale} if has_scale else {}))
    method = learned[name].method(settings, chosen.loss)
    weights = train(method, config)
    print(f"{weights}: use it with `jaxsr upscale SEQ --method {weights} --scale {config.scale}`")


def _without_groups(options: type) -> Any:
    """The options without what the command line does not offer: constants of filters, and a second scale."""
    hidden = [
        (field.name, Annotated[field.type, tyro.conf.Suppress], field.default)
        for field in dataclasses.fields(options)
        if dataclasses.is_dataclass(field.type) or field.name == "scale"
    ]
    if not hidden:
        return options
    return dataclasses.make_dataclass(options.__name__, hidden, bases=(options,), frozen=True)


_OLD_NAMES = {
    "--follow-jitter": "--unjitter",
    "--no-follow-jitter": "--no-unjitter",
    "--compute": "--dtype",
    "--start": "--base",
    "--color": "",
}


def _joined(option: str, arguments: Sequence[str]) -> list[str]:
    """The arguments with all values of an option, which may be given several times, in one place."""
    others: list[str] = []
    values: list[str] = []
    place, inside = None, False
    for argument in arguments:
        name, equals, value = argument.partition("=")
        if name == option:
            place = len(others) if place is None else place
            values += [value] if equals else []
            inside = not equals
        elif inside and not argument.startswith("-"):
            values.append(argument)
        else:
            others.append(argument)
            inside = False
    return others if place is None else [*others[:place], option, *values, *others[place:]]


def _renamed(arguments: Sequence[str], own: Collection[str] = ()) -> list[str]:
    """The arguments with the names that options have now; old ones still work, and a line says so.

    Args:
        arguments: after the name of the method.
        own: names of the method's settings, which are never renamed.

    Raises:
        JaxsrError: an old option with a value that it never had.
    """
    new: list[str] = []
    rest = iter(arguments)
    for argument in rest:
        name, equals, value = argument.partition("=")
        if name not in _OLD_NAMES or name.strip("-").replace("-", "_") in own:
            new.append(argument)
            continue
        if name == "--color":
            choice = value or next(rest, "")
            if choice not in ("display", "lighting"):
                raise JaxsrError("bad color", where=name, expected="display or lighting", found=choice)
            now = ["--demodulated" if choice == "lighting" else "--no-demodulated"]
        elif name == "--start":
            choice = value or next(rest, "")
            now = ["--base", "none" if choice == "nothing" else choice]
        else:
            now = [_OLD_NAMES[name] + equals + value]
        print(f"jaxsr train: {name} is now {' '.join(now)}; the old name will go", file=sys.stderr)
        new += now
    return new
