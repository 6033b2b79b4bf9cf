"""What commands that run jobs print at the end, and the exit code they return."""

from __future__ import annotations

import traceback
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from deep_io.atomic import Existing
    from pipelines.jobs import JobReport


def existing_choice(overwrite: bool, skip_existing: bool) -> Existing:
    """The two flags as one choice. Raises UsageError when both are set, both on the command line or neither there."""
    if overwrite and skip_existing:
        raise click.UsageError("--overwrite and --skip-existing exclude each other", click.get_current_context())
    return "overwrite" if overwrite else "skip" if skip_existing else "refuse"


def end_job(report: JobReport[Any]) -> int:
    """Lists what failed (each failure was told when it happened, perhaps thousands of lines ago) and sums up."""
    context = click.get_current_context()
    if len(report.frames) > 1 and report.failed:
        click.echo("failed frames:", err=True)
        for frame in report.failed:
            click.echo(f"  {frame.label}: {frame.told}", err=True)
    if isinstance(context.obj, dict) and context.obj["debug"]:
        for frame in report.failed:
            traceback.print_exception(frame.error)
    if len(report.frames) > 1 or not report.failed:
        click.echo(report.summary(), err=True)
    return report.exit_code
