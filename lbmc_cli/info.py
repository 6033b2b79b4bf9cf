"""`lbmc info`: what a file holds and how it would be read."""

from __future__ import annotations

import json
from typing import Any

import click

from lbmc_cli.options import LbmcCommand, option, reading_options


@click.command(cls=LbmcCommand)
@click.argument("source", metavar="IN")
@option("--json", "as_json", is_flag=True, help="Print JSON.")
@reading_options
def info(source: str, as_json: bool, part: str | None, **choices: Any) -> None:
    """Show IN's headers, which channels play which role, the weighting, statistics of the samples, and what a denoising
    job would do without. Of a sequence, such as shot.####.exr, the first frame is shown."""
    from deep_io.errors import InputError
    from pipelines.info import FileInfo, RefusedFile, file_info, first_file, refused_file

    def show(found: FileInfo | RefusedFile) -> None:
        click.echo(json.dumps(found.as_dict(), indent=2, allow_nan=False) if as_json else "\n".join(found.lines()))

    path = first_file(source)
    try:
        show(file_info(path, part=part, **choices))
    except InputError:  # whoever asks why a file is refused wants to see what is in it
        show(refused_file(path, part, choices["overrides"]))
        raise
