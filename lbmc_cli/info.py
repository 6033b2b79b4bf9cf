"""`lbmc info`: what a file holds and how it would be read."""

from __future__ import annotations

import json
from typing import Any

import click

from lbmc_cli.options import LbmcCommand, option, part_choice, reading_options


@click.command(cls=LbmcCommand)
@click.argument("source", metavar="IN")
@option("--json", "as_json", is_flag=True, help="Print JSON.")
@reading_options
def info(source: str, as_json: bool, part: str | None, **choices: Any) -> None:
    """Show IN's headers, which channels play which role, the weighting, statistics of the samples, and what a denoising
    job would do without."""
    from pipelines.info import file_info

    found = file_info(source, part=part_choice(part), **choices)
    click.echo(json.dumps(found.as_dict(), indent=2) if as_json else "\n".join(found.lines()))
