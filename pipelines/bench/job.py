"""`lbmc bench` as a function: finds the scenes, has them measured, and writes the three files that come out.

What runs in which order is protocol.py's.
"""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path
from typing import Any

from deep_io.atomic import atomic_output, output_action
from deep_io.errors import InputError
from pipelines.bench.options import BenchOptions
from pipelines.bench.protocol import Bench
from pipelines.bench.report import html_report, load_pillow
from pipelines.bench.results import Results
from pipelines.bench.scenes import find_pairs, open_scenes, without_reference
from pipelines.bench.tables import markdown_report

RESULTS, TABLE, REPORT = "results.json", "results.md", "report.html"


def bench(options: BenchOptions) -> Results:
    """Measures, and writes results.json, results.md and report.html into `options.out`, which is made if need be.

    A scene that cannot be read is told at once and left out; `Results.failed` has it. So are deep files without a
    reference. What a method cannot do on one scene is told too, and in `Results.gaps`; all else is measured. Raises
    InputError for what is wrong with the folder or with every scene, UsageError without Pillow, for outputs that exist
    and for models that do not.
    """
    load_pillow()
    scenes, failed = open_scenes(find_pairs(options.folder, options.match))
    unpaired = without_reference(options.folder, options.match)
    targets = [options.out / name for name in (RESULTS, TABLE, REPORT)]
    if options.out.is_dir():
        for target in targets:
            output_action(target, [scene.source for scene in scenes], "overwrite" if options.overwrite else "refuse",
                          can_skip=False)
    with tempfile.TemporaryDirectory(prefix="lbmc-bench-") as folder, Bench(options, scenes, Path(folder)) as run:
        run.results.failed.update(failed)
        run.results.protocol["without_reference"] = unpaired
        try:  # only now, when every model was found, but before any work
            options.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{options.out}: cannot be made a folder ({error.strerror}); name another --out"
                             ) from error
        results, gallery = run.measure()
    texts = (json.dumps(_plain(results.to_dict()), indent=1, ensure_ascii=False) + "\n", markdown_report(results),
             html_report(results, gallery))
    for target, text in zip(targets, texts, strict=True):
        with atomic_output(target) as path:
            path.write_text(text, "utf-8")
    return results


def _plain(value: Any) -> Any:
    """JSON knows no infinity and no NaN: they become null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if not isinstance(value, float) or math.isfinite(value) else None
