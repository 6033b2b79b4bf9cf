"""The `lbmc` command: the table of its subcommands, and how a run ends (exit codes, error lines, signals).

Nothing heavy is imported here: a subcommand's module is imported when it runs, and its pipeline when it starts work.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO

import click

COMMANDS = {
    "denoise": "Denoise a deep sample file, or a sequence of them, to a flat beauty.",
    "export-layers": "Write the denoised layers as deep samples, parts, channels or files.",
    "info": "Show what a deep sample file holds and how it would be read.",
    "pack": "Pack one-sample flat renders into one deep sample file.",
    "compare": "Measure an image against its reference.",
    "bench": "Measure speed against error on a folder of scenes, beside other denoisers.",
    "render": "Render training scenes with Mitsuba: deep samples and references.",
    "train": "Train a network on deep sample files with references.",
    "tune": "Fit weights to a shot by its own samples, without a reference.",
    "models": "List the weights that are here.",
}
"""Subcommands in the order of `--help`; each lives in lbmc_cli/NAME.py as a click command of that name."""

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2
EXIT_SIGNAL = 128
"""What shells add to the number of the signal that ended a program."""
STOPPED_WORDS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class LazyGroup(click.Group):
    """A group whose subcommands come from COMMANDS and are imported only when one of them is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        name = cmd_name.replace("-", "_")
        command: click.Command = getattr(import_module(f"lbmc_cli.{name}"), name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


def _print_version(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        from pipelines import __version__

        click.echo(f"lbmc {__version__}")
        ctx.exit()


@click.command(
    cls=LazyGroup,
    context_settings={"auto_envvar_prefix": "LBMC", "help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Show version."
)
@click.option("--debug", is_flag=True, help="Show the traceback of an error.")
def lbmc(debug: bool) -> None:
    """Denoise deep EXRs whose samples are Monte Carlo path samples.

    Every option can also be given as an environment variable: LBMC_THREADS for --threads of every command,
    LBMC_DENOISE_THREADS for that of denoise alone. One of a repeatable option holds a value a line.
    """


def refuse_shadowed_packages() -> None:
    """Raises ClickException where `import model` would not find the `model` that belongs to this `lbmc`.

    The package names are generic; a folder of the same name on PYTHONPATH, or in the current directory of
    `python -m`, would be imported in place of ours and fail in baffling ways.
    """
    home = Path(__file__).resolve().parent.parent
    for package in ("deep_io", "model", "pipelines"):
        spec = find_spec(package)
        if spec is None:
            raise click.ClickException(f"lbmc's own package {package!r} is missing from {home}; install lbmc again")
        found = spec.origin or next(iter(spec.submodule_search_locations or ()), "")
        if not Path(found).resolve().is_relative_to(home / package):
            raise click.ClickException(
                f"lbmc needs its own package {package!r} of {home}, but another one, {found}, comes first; "
                "take its folder off PYTHONPATH, or run lbmc from another folder"
            )


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `lbmc` with `arguments` (default: the process's own) and returns its exit code, whatever happens.

    0 done; 1 some frames failed, or an unexpected error; 2 usage or a refused output; 3 an unreadable or unsuitable
    input; 130 and 143 after SIGINT and SIGTERM. Errors are one line on stderr that starts with `ERROR:`.
    """
    _take_any_text(sys.stdout, sys.stderr)
    try:
        refuse_shadowed_packages()
    except click.ClickException as error:
        return _report(error.format_message(), error.exit_code)
    # OpenMP reads it when torch is loaded. Threads that wait by spinning cost five to forty times the work itself on
    # a machine that other processes share, which farm machines are; sleeping costs nothing measurable on an idle one.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from pipelines.signals import StoppedError, stopped_by_signals

    warnings.showwarning = _show_warning
    context: dict[str, Any] = {"debug": False}
    try:
        with stopped_by_signals():
            result = lbmc.main(
                args=None if arguments is None else list(arguments),
                prog_name="lbmc",
                standalone_mode=False,
                obj=context,
            )
        return int(result or EXIT_OK)
    except click.exceptions.NoArgsIsHelpError as help_wanted:
        help_wanted.show()
        return EXIT_USAGE
    except click.UsageError as error:
        hint = f" (see: {error.ctx.command_path} --help)" if error.ctx is not None else ""
        return _report(error.format_message() + hint, error.exit_code)
    except click.ClickException as error:
        return _report(error.format_message(), error.exit_code)
    except StoppedError as stopped:
        return _report(STOPPED_WORDS[stopped.number], EXIT_SIGNAL + stopped.number)
    except BrokenPipeError:
        # The reader of our output left (`lbmc info x.exr | head`); Python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except Exception as error:
        if context["debug"]:
            traceback.print_exception(error)
        from pipelines.jobs import describe_error

        return _report(describe_error(error), getattr(error, "exit_code", EXIT_FAILED))


def _take_any_text(*streams: TextIO) -> None:
    """Lets streams print what they cannot encode as escapes: names and header text need not be UTF-8."""
    for stream in streams:
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _report(text: str, code: int) -> int:
    print(f"ERROR: {' '.join(text.split())}", file=sys.stderr, flush=True)
    return code


def _show_warning(message: Warning | str, *details: Any, **more: Any) -> None:
    """Warnings in the same form as errors: one line, without the place in our code that raised them."""
    print(f"WARNING: {' '.join(str(message).split())}", file=sys.stderr, flush=True)
