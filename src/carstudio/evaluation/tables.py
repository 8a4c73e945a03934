"""Tables as data, written out as Markdown, LaTeX or HTML; and the table of a set of summaries.

Every table of results says in its caption what was measured, by which protocol and on which split (DESIGN decision 5).
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from carstudio.evaluation.results import METRIC_DEFINITION
from carstudio.evaluation.summary import Summary

Mark = Literal["", "best", "second"]
TableFormat = Literal["markdown", "latex", "html"]


@dataclass(frozen=True)
class Cell:
    """Text of a cell, whether it is the best or second best of its column, and small print beside it."""

    text: str
    mark: Mark = ""
    detail: str = ""


@dataclass(frozen=True)
class Table:
    """A caption, column heads, rows of cells (the first column names the row) and notes below."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Column:
    metric: str
    title: str
    digits: int
    larger_is_better: bool


_COLUMNS = (
    _Column("psnr", "PSNR (dB) ↑", 2, True),
    _Column("ssim", "SSIM ↑", 4, True),
    _Column("lpips", "LPIPS ↓", 4, False),
    _Column("psnr_mask", "PSNR (car) ↑", 2, True),
    _Column("ssim_mask", "SSIM (car) ↑", 4, True),
    _Column("mask_iou", "Mask IoU ↑", 4, True),
)


def result_tables(summaries: Sequence[Summary], *, intervals: bool = False) -> list[Table]:
    """One table per (protocol, split), methods as rows, best and second best marked where there are several.

    `intervals` adds the 95 % interval of each mean. Marks go by the figures as printed, so equal figures share a mark.
    """
    groups: dict[tuple[str, str], list[Summary]] = {}
    for summary in summaries:
        groups.setdefault((summary.protocol, summary.split), []).append(summary)
    return [_result_table(protocol, split, group, intervals) for (protocol, split), group in groups.items()]


def _result_table(protocol: str, split: str, group: Sequence[Summary], intervals: bool) -> Table:
    columns = [column for column in _COLUMNS if any(column.metric in summary.metrics for summary in group)]
    marked = [_metric_cells(column, group, intervals) for column in columns]
    rows = tuple(
        (Cell(summary.method), Cell(str(summary.num_images)), Cell(str(summary.num_instances)), *cells)
        for summary, *cells in zip(group, *marked, strict=True)
    )
    notes = [METRIC_DEFINITION]
    if intervals:
        notes.append("In brackets the 95 % interval of the mean, by resampling cars.")
    if not any("lpips" in summary.metrics for summary in group):
        notes.append("LPIPS was not measured; the header of the result file says why.")
    return Table(
        caption=f"Protocol {protocol}, split {split}",
        columns=("Method", "Images", "Cars", *(column.title for column in columns)),
        rows=rows,
        notes=tuple(notes),
    )


def _metric_cells(column: _Column, group: Sequence[Summary], intervals: bool) -> list[Cell]:
    estimates = [summary.metrics.get(column.metric) for summary in group]
    printed = [None if found is None else f"{found.mean:.{column.digits}f}" for found in estimates]
    ranked = sorted({float(text) for text in printed if text is not None}, reverse=column.larger_is_better)
    cells = []
    for found, text in zip(estimates, printed, strict=True):
        if found is None or text is None:
            cells.append(Cell("–"))
            continue
        detail = ""
        if intervals and found.low is not None and found.high is not None:
            detail = f"[{found.low:.{column.digits}f}, {found.high:.{column.digits}f}]"
        cells.append(Cell(text, _mark(ranked.index(float(text)), len(group)), detail))
    return cells


def _mark(rank: int, rivals: int) -> Mark:
    if rivals < 2 or rank > 1:
        return ""
    return "best" if rank == 0 else "second"


def write_table(table: Table, style: TableFormat) -> str:
    """The table as text that ends with a newline."""
    return {"markdown": to_markdown, "latex": to_latex, "html": to_html}[style](table)


def to_markdown(table: Table) -> str:
    """GitHub Markdown: best bold, second best italic."""

    def escape(text: str) -> str:
        escaped = "".join(f"\\{character}" if character in "\\|*_`" else character for character in text)
        return escaped.replace("<", "&lt;").replace("\n", " ")

    def cell(item: Cell) -> str:
        text = {"best": "**{}**", "second": "*{}*", "": "{}"}[item.mark].format(escape(item.text))
        return f"{text} {escape(item.detail)}".rstrip()

    lines = [f"**{escape(table.caption)}.** {' '.join(escape(note) for note in table.notes)}".rstrip(), ""]
    lines.append(f"| {' | '.join(escape(column) for column in table.columns)} |")
    lines.append(f"|{'|'.join(['---'] + ['---:'] * (len(table.columns) - 1))}|")
    lines += [f"| {' | '.join(cell(item) for item in row)} |" for row in table.rows]
    return "\n".join(lines) + "\n"


_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {character: f"\\{character}" for character in "&%$#_{}"}
_LATEX |= {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "–": "--"}


def to_latex(table: Table) -> str:
    r"""A `table` float with booktabs rules: best \textbf, second best \underline."""

    def escape(text: str) -> str:
        return "".join(_LATEX.get(character, character) for character in text)

    def cell(item: Cell) -> str:
        text = {"best": r"\textbf{%s}", "second": r"\underline{%s}", "": "%s"}[item.mark] % escape(item.text)
        return text + (rf" {{\scriptsize {escape(item.detail)}}}" if item.detail else "")

    caption = " ".join([f"{escape(table.caption)}.", *(escape(note) for note in table.notes)])
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{caption}}}"]
    lines += [rf"\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}", r"\toprule"]
    lines += [" & ".join(escape(column) for column in table.columns) + r" \\", r"\midrule"]
    lines += [" & ".join(cell(item) for item in row) + r" \\" for row in table.rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"]) + "\n"


def to_html(table: Table) -> str:
    """A `<table class="results">`: best in `<strong>`, second best in `<em>`; notes in the caption."""
    escape = html.escape

    def cell(item: Cell, tag: str) -> str:
        text = {"best": "<strong>{}</strong>", "second": "<em>{}</em>", "": "{}"}[item.mark].format(escape(item.text))
        detail = f" <small>{escape(item.detail)}</small>" if item.detail else ""
        return f"<{tag}>{text}{detail}</{tag.split()[0]}>"

    notes = "".join(f' <span class="note">{escape(note)}</span>' for note in table.notes)
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in table.columns)
    lines = ['<table class="results">', f"<caption><b>{escape(table.caption)}</b>{notes}</caption>"]
    lines += [f"<thead><tr>{head}</tr></thead>", "<tbody>"]
    for first, *others in table.rows:
        cells = [cell(first, 'th scope="row"'), *(cell(item, "td") for item in others)]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return "\n".join([*lines, "</tbody>", "</table>"]) + "\n"
