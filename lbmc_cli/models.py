"""`lbmc models`: which weights are here."""

from __future__ import annotations

import dataclasses
import json

import click

from lbmc_cli.options import LbmcCommand, option


@click.command(cls=LbmcCommand)
@option("--json", "as_json", is_flag=True, help="Print JSON, with every preset's config, recipe and scores.")
def models(as_json: bool) -> None:
    """List the presets that --model takes."""
    from pipelines.presets import presets

    found = presets()
    if as_json:
        click.echo(json.dumps([dataclasses.asdict(preset) for preset in found], indent=2))
        return
    for preset in found:
        name = f"{preset.name} (default)" if preset.default else preset.name
        click.echo(f"{name:<20}{preset.bytes / 1e6:6.1f} MB  {preset.digest}  {preset.description}")
    if not found:
        click.echo("no presets are installed; pass a .safetensors file to --model")
