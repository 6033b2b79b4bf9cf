"""`lbmc compare`: an image, or a sequence, against its reference."""

from __future__ import annotations

import click

from lbmc_cli.options import LbmcCommand, option


@click.command(cls=LbmcCommand)
@click.argument("image", metavar="IMAGE")
@click.argument("reference", metavar="REFERENCE")
@option(
    "--other-half",
    metavar="FILE",
    help="REFERENCE and this are independent halves: also measure free of the reference's own noise.",
)
@option("--json", "as_json", is_flag=True, help="Print JSON.")
def compare(image: str, reference: str, other_half: str | None, as_json: bool) -> None:
    """Measure IMAGE against REFERENCE."""
    from pipelines.compare import compare as run
    from pipelines.compare import score_lines

    click.echo("\n".join(score_lines(run(image, reference, other_half).scores)))
