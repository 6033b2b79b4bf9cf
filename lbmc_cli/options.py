"""What the subcommands share: the command class with --debug, options that read LBMC_* variables, parameter types."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import click
from click.core import ParameterSource

Options = TypeVar("Options")

MOST_THREADS = 1024  # more than any machine has; far more crash the numeric libraries

RIVALS = tuple(map(frozenset, (
    ("overwrite", "skip_existing"), ("exposure", "exposure_from"), ("scene", "layout"),
    ("samples", "form"), ("samples", "contributions"), ("samples", "aovs"), ("samples", "ids"),
)))
"""Pairs of options that exclude each other: of two, that of the command line wins over that of the environment."""

_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


class LbmcCommand(click.Command):
    """A subcommand: `--debug` works after its name too."""

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.params.append(
            click.Option(
                ["--debug"],
                is_flag=True,
                expose_value=False,
                callback=_note_debug,
                help="Show the traceback of an error.",
            )
        )

    def invoke(self, ctx: click.Context) -> Any:
        _note_debug(ctx, None, bool(ctx.find_root().params.get("debug")))
        return super().invoke(ctx)


def _note_debug(ctx: click.Context, parameter: click.Parameter | None, value: bool) -> None:
    if value and isinstance(ctx.obj, dict):
        ctx.obj["debug"] = True


class LbmcOption(click.Option):
    """An option that LBMC_<COMMAND>_<OPTION>, or LBMC_<OPTION> for all commands at once, can stand in for.

    The name is that of the first flag: LBMC_NO_ADAPT=1 for --no-adapt. A variable holds the values of a repeatable
    option a line each, and counts for nothing where the option that excludes its own is on the command line.
    """

    def consume_value(self, ctx: click.Context, opts: Mapping[str, Any]) -> tuple[Any, ParameterSource]:
        value, source = super().consume_value(ctx, opts)
        rivals = {name for pair in RIVALS if self.name in pair for name in pair} - {self.name}
        if source is ParameterSource.ENVIRONMENT and rivals & opts.keys():
            return self.get_default(ctx), ParameterSource.DEFAULT
        return value, source

    def value_from_envvar(self, ctx: click.Context) -> Any:
        text = self.resolve_envvar_value(ctx)
        if text is None or not self.multiple:
            return super().value_from_envvar(ctx)
        return [line.strip() for line in text.splitlines() if line.strip()]

    def resolve_envvar_value(self, ctx: click.Context) -> str | None:
        name = self._variable(ctx)
        return None if name is None else os.environ[name]

    def process_value(self, ctx: click.Context, value: Any) -> Any:
        try:
            return super().process_value(ctx, value)
        except click.BadParameter as error:
            if self.name and ctx.get_parameter_source(self.name) is ParameterSource.ENVIRONMENT:
                message = f"{error.message} (from the environment variable {self._variable(ctx)})"
                raise click.BadParameter(message, ctx, self) from error
            raise

    def _variable(self, ctx: click.Context) -> str | None:
        """The name of the variable that stands in for the option, None where none is set."""
        flag = next(name for name in self.opts if name.startswith("--")).lstrip("-").replace("-", "_").upper()
        contexts = (ctx, ctx.find_root())
        names = (f"{context.auto_envvar_prefix}_{flag}" for context in contexts if context.auto_envvar_prefix)
        return next((name for name in names if os.environ.get(name)), None)


option: Callable[..., Callable[[Any], Any]] = partial(click.option, cls=LbmcOption)
"""click.option, with LBMC_* variables as described at LbmcOption."""


class ByteSize(click.ParamType[int]):
    """A size in bytes with an optional unit: 2GiB, 512M, 1.5g; units are powers of 1024."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)(?:I?B)?", str(value).strip().upper())
        if match is None or float(match[1]) == 0.0:
            self.fail(f"{value!r} is not a size; write 2GiB or 512MiB", param, ctx)
        return int(float(match[1]) * _UNITS[match[2]])


class Device(click.ParamType[str]):
    """auto, cpu, cuda or cuda:N. Whether the device exists is found out by the job."""

    name = "device"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if re.fullmatch(r"auto|cpu|cuda(:\d{1,3})?", str(value)) is None:
            self.fail(f"{value!r} is not auto, cpu, cuda or cuda:N", param, ctx)
        return str(value)


def role_overrides(ctx: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    """Callback of --map: ("normal=N", ...) to {"normal": "N", ...}."""
    overrides: dict[str, str] = {}
    for value in values:
        role, separator, layer = value.partition("=")
        if not separator or not role:
            raise click.BadParameter(f"{value!r} is not ROLE=LAYER", ctx, parameter)
        if role in overrides:
            raise click.BadParameter(f"role {role!r} is given twice", ctx, parameter)
        overrides[role] = layer
    return overrides


def build_options(kind: Callable[..., Options], **choices: Any) -> Options:
    """kind(**choices), a pipeline's options; a value that they refuse becomes a usage error."""
    try:
        return kind(**choices)
    except ValueError as error:
        raise click.UsageError(str(error), click.get_current_context()) from error


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def together(*decorators: Decorator) -> Decorator:
    """Several options as one decorator; `--help` shows them in this order."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


mapping_options = together(
    option(
        "--map",
        "overrides",
        multiple=True,
        metavar="ROLE=LAYER",
        callback=role_overrides,
        help="Layer or channel that plays a role, e.g. normal=N_world; empty drops the role. Repeatable.",
    ),
    option(
        "--normals",
        type=click.Choice(["auto", "world", "view"]),
        default="auto",
        show_default=True,
        help="Space of the normals.",
    ),
    option(
        "--depth",
        type=click.Choice(["auto", "z", "distance"]),
        default="auto",
        show_default=True,
        help="Planar depth, or distance along the ray.",
    ),
    option(
        "--camera",
        metavar="FILE|DEGREES",
        help="Camera that the input's header lacks: an EXR or JSON file, or the horizontal field of view.",
    ),
)
"""Which channels play which role, and in which convention."""

reading_options = together(
    option("--part", help="Part of a multi-part file, by name or number from 0.  [default: the only deep part]"),
    option(
        "--weighting",
        type=click.Choice(["uniform", "packed", "over"]),
        help="How samples are weighted.  [default: by the header; uniform where every alpha is 0 or 1]",
    ),
    mapping_options,
)
"""How a deep sample file is read; the same for every command that reads one."""

THREAD_COUNT = click.IntRange(1, MOST_THREADS)
"""Type of every option that says how many threads or processes there are to be."""
THREADS = option(
    "--threads",
    type=THREAD_COUNT,
    metavar="N",
    help="CPU threads.  [default: all that the process may use]",
)
PROGRESS = option(
    "--progress",
    type=click.Choice(["auto", "bar", "plain", "openjd", "none"]),
    default="auto",
    show_default=True,
    help="auto: a bar on a terminal, else plain lines.",
)
