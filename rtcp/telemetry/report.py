"""Report on a folder of experiments: one self-contained HTML file with results and pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from rtcp.telemetry.experiments.experiment import RESULT, ExperimentFailed, Result, Row, read_result, shown

_MOST_FOLDERS = 3


def page(folders: Sequence[Path]) -> str:
    """Return the report on one folder, or on two or three side by side, as HTML.

    Raises:
        ExperimentFailed: no results, or damaged ones; more than three folders.
    """
    if not 1 <= len(folders) <= _MOST_FOLDERS:
        raise ExperimentFailed(f"found {len(folders)} folders, allowed are 1 to {_MOST_FOLDERS}")
    result_sets = [_results(folder) for folder in folders]
    names = list(dict.fromkeys(name for results in result_sets for name in results))
    sections = []
    for name in names:
        ran = [results[name] for results in result_sets if name in results]
        sections.append({
            "title": ran[0][1].title,
            "name": name,
            "runs": [{"result": result, "pictures": _pictures(place, result)} for place, result in ran],
            "figures": _side_by_side([results[name][1] if name in results else None for results in result_sets]),
        })  # fmt: skip
    environment = Environment(
        loader=PackageLoader("rtcp.telemetry", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["shown"] = shown
    return environment.get_template("report.html").render(
        folders=[folder.absolute().name for folder in folders],
        hosts=[next(iter(results.values()))[1].host for results in result_sets],
        sections=sections,
    )


def _results(folder: Path) -> dict[str, tuple[Path, Result]]:
    """Return name -> (folder, latest result) of a folder, or of the folders in it."""
    files = [folder / RESULT] if (folder / RESULT).exists() else sorted(folder.glob(f"*/{RESULT}"))
    if not files:
        raise ExperimentFailed(f"{folder}: there are no results of experiments ({RESULT}) in it or in its folders")
    results = sorted(((file.parent, read_result(file.parent)) for file in files), key=lambda entry: entry[1].began)
    return {result.name: (place, result) for place, result in results}


def _side_by_side(results: Sequence[Result | None]) -> list[tuple[Row, list[Row | None]]]:
    """Return each figure's first existing row, for source and aim, and its row of each folder."""
    rows = [{row.figure: row for row in result.rows} if result else {} for result in results]
    figures = dict.fromkeys(figure for by_figure in rows for figure in by_figure)
    table = []
    for figure in figures:
        of_each = [by_figure.get(figure) for by_figure in rows]
        table.append((next(row for row in of_each if row), of_each))
    return table


def _pictures(place: Path, result: Result) -> list[str]:
    """Return the pictures of a result as data URLs, without missing files."""
    urls = []
    for name in result.pictures:
        path = place / f"{name}.png"
        if path.exists():
            urls.append("data:image/png;base64," + base64.b64encode(path.read_bytes()).decode())
    return urls
