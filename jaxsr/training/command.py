"""`jaxsr train METHOD`: the options of a training and those of a method, as one command line."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from jaxsr.errors import JaxsrError
from jaxsr.methods import LEARNED, Learned
from jaxsr.training.config import TrainConfig
from jaxsr.training.loop import train

DESCRIPTION = """Train the network of a method; run again, go on with it.

Every option is one of a dataclass: of the training (jaxsr.training.TrainConfig), or of the method."""


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
    options = learned[name].options
    for_one_scale = any(field.name == "scale" for field in dataclasses.fields(options))
    if for_one_scale:  # that of the training: one option, not two
        hidden = [("scale", Annotated[int, tyro.conf.Suppress], 1)]
        options = dataclasses.make_dataclass(options.__name__, hidden, bases=(options,), frozen=True)
    both = dataclasses.make_dataclass(
        "both", [("training", TrainConfig, TrainConfig()), ("method", options, options())]
    )
    chosen: Any = tyro.cli(
        both,
        args=rest,
        prog=f"jaxsr train {name}",
        description=DESCRIPTION,
        config=(tyro.conf.OmitArgPrefixes,),
    )
    config, chosen_options = chosen.training, chosen.method
    if for_one_scale:
        chosen_options = dataclasses.replace(chosen_options, scale=config.scale)
    method = learned[name].method(chosen_options)
    weights = train(method, config)
    print(f"{weights}: use it with `jaxsr upscale SEQ --method {weights} --scale {config.scale}`")
