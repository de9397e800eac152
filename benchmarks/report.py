"""What a run found: numbers by section, as JSON for the next run and as Markdown for people."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

FORMAT = "gsseg-benchmark-1"


@dataclass(frozen=True)
class Row:
    """One number; with several runs the median, the least and the most."""

    section: str
    name: str
    unit: str
    value: float
    least: float
    most: float
    runs: int


@dataclass(frozen=True)
class Bar:
    """What a number should be: at most `limit`, or at least if `at_least`."""

    what: str
    section: str
    name: str
    limit: float
    at_least: bool = False


@dataclass
class Report:
    """Collects a run.

    Attributes
    ----------
    sizes : str
        Which sizes were measured; only runs of the same are compared.
    date : str
        When.
    machine : dict
        Where, with which versions.
    rows : list of Row
        The numbers, in the order of measuring.
    said : dict of str to list of str
        Sentences by section.
    """

    sizes: str
    date: str
    machine: dict[str, Any]
    rows: list[Row] = field(default_factory=list)
    said: dict[str, list[str]] = field(default_factory=dict)

    def add(self, section: str, name: str, unit: str, values: Sequence[float]) -> None:
        """Add a number that was measured once or several times."""
        self.said.setdefault(section, [])
        self.rows.append(Row(section, name, unit, statistics.median(values), min(values), max(values), len(values)))

    def say(self, section: str, text: str) -> None:
        """Add a sentence to a section."""
        self.said.setdefault(section, []).append(text)

    def value(self, section: str, name: str) -> float | None:
        """Look a number up."""
        return next((row.value for row in self.rows if (row.section, row.name) == (section, name)), None)

    def write(self, folder: Path, text: str, bars: Sequence[Bar] = ()) -> None:
        """Write BENCHMARK.md, compared with the BENCHMARK.json that lies there, and replace that one.

        Parameters
        ----------
        folder : path
            Gets both files.
        text : str
            What stands above the numbers.
        bars : sequence of Bar
            What is asked for.
        """
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "BENCHMARK.json"
        page = self.markdown(text, Report.load(path), bars)
        (folder / "BENCHMARK.md").write_text(page, encoding="utf-8")
        content = {"format": FORMAT, **asdict(self)}
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> Report | None:
        """Read an earlier run; None where there is none."""
        if not path.is_file():
            return None
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("format", None) != FORMAT:
            return None
        return cls(**{**content, "rows": [Row(**row) for row in content["rows"]]})

    def markdown(self, text: str, last: Report | None, bars: Sequence[Bar] = ()) -> str:
        """Write everything down, beside an earlier run of the same sizes."""
        compared = last if last is not None and last.sizes == self.sizes else None
        parts = [text, "## Machine", markdown(["", ""], [[key, str(value)] for key, value in self.machine.items()])]
        parts.append(self._compared_with(last, compared))
        if bars:
            judged = [[*self._judge(bar), _found(compared, bar)] for bar in bars]
            parts += ["## What was asked for", markdown(["what", "bar", "measured", "", "last time"], judged)]
        for section, sentences in self.said.items():
            parts += [f"## {section[:1].upper()}{section[1:]}", *sentences]
            rows = [self._line(row, compared) for row in self.rows if row.section == section]
            if rows:
                parts.append(markdown(["", "median", "spread", "runs", "last time", "now / last"], rows))
        return "\n\n".join(part.strip("\n") for part in parts) + "\n"

    def _compared_with(self, last: Report | None, compared: Report | None) -> str:
        if compared is not None:
            machine = compared.machine
            where = f"{machine.get('processor')}, {machine.get('cores')} cores"
            return f'"Last time" is the run of {compared.date} on: {where}.'
        why = "there was no earlier run" if last is None else f"the earlier run was of other sizes ({last.sizes})"
        return f'"Last time" is empty: {why}.'

    def _line(self, row: Row, compared: Report | None) -> list[str]:
        factor, unit = (1000, "ms") if row.unit == "s" and abs(row.value) < 0.1 else (1, row.unit)
        spread = f"{short(factor * row.least)} to {short(factor * row.most)}" if row.runs > 1 else ""
        before = compared.value(row.section, row.name) if compared is not None else None
        last = "" if before is None else short(factor * before)
        ratio = f"{row.value / before:.2f}" if before else ""
        return [row.name, f"{short(factor * row.value)} {unit}".strip(), spread, str(row.runs), last, ratio]

    def _judge(self, bar: Bar) -> list[str]:
        value = self.value(bar.section, bar.name)
        limit = f"at {'least' if bar.at_least else 'most'} {short(bar.limit)}"
        if value is None:
            return [bar.what, limit, "not measured", ""]
        met = value >= bar.limit if bar.at_least else value <= bar.limit
        return [bar.what, limit, short(value), "met" if met else "**not met**"]


def _found(report: Report | None, bar: Bar) -> str:
    value = report.value(bar.section, bar.name) if report is not None else None
    return "" if value is None else short(value)


def short(value: float) -> str:
    """Write a number with three digits that count."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):,.{max(digits, 0)}f}"


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Write a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "/") for cell in line) + " |" for line in lines)
