"""Tables: marks, escapes, one shape in three formats."""

import re
import xml.etree.ElementTree as ElementTree

from carstudio.evaluation.summary import Estimate, Summary
from carstudio.evaluation.tables import Cell, Table, result_tables, to_html, to_latex, to_markdown, write_table


def summary(method, psnr, lpips=None, protocol="novel-view"):
    metrics = {"psnr": Estimate(psnr, psnr - 1, psnr + 1, 8), "ssim": Estimate(psnr / 100, None, None, 8)}
    if lpips is not None:
        metrics["lpips"] = Estimate(lpips, lpips, lpips, 8)
    return Summary(
        method=method, protocol=protocol, split="instance", num_images=8, num_instances=4, metrics=metrics
    )  # fmt: skip


def column(table, title):
    place = next(i for i, name in enumerate(table.columns) if name.startswith(title))
    return [row[place] for row in table.rows]


def test_best_and_second_best_follow_each_metrics_direction():
    (table,) = result_tables([summary("a", 20.0, 0.3), summary("b", 22.0, 0.1), summary("c", 21.0, 0.2)])
    assert [cell.mark for cell in column(table, "PSNR (dB)")] == ["", "best", "second"]
    assert [cell.mark for cell in column(table, "LPIPS")] == ["", "best", "second"]
    assert [cell.text for cell in column(table, "Method")] == ["a", "b", "c"]


def test_figures_that_print_alike_share_their_mark():
    (table,) = result_tables([summary("a", 22.001), summary("b", 21.999), summary("c", 21.0)])
    assert [cell.mark for cell in column(table, "PSNR (dB)")] == ["best", "best", "second"]


def test_a_single_method_is_not_called_best():
    (table,) = result_tables([summary("a", 22.0)])
    assert {cell.mark for row in table.rows for cell in row} == {""}


def test_protocols_do_not_share_a_table_and_each_says_what_it_is():
    tables = result_tables([summary("a", 22.0), summary("a", 30.0, protocol="input-view")])
    assert [table.caption for table in tables] == [
        "Protocol novel-view, split instance",
        "Protocol input-view, split instance",
    ]
    for table in tables:
        for style in ("markdown", "latex", "html"):
            text = write_table(table, style)
            assert "truth on black" in text
            assert "split instance" in text
            assert "LPIPS was not measured" in text


def test_a_missing_metric_is_a_dash_and_intervals_are_optional():
    summaries = [summary("a", 22.0, 0.1), summary("b", 21.0)]
    (table,) = result_tables(summaries, intervals=True)
    assert column(table, "LPIPS")[1] == Cell("–")
    assert column(table, "PSNR (dB)")[0].detail == "[21.00, 23.00]"
    assert column(table, "SSIM")[0].detail == ""
    assert {cell.detail for row in result_tables(summaries)[0].rows for cell in row} == {""}


NASTY = Table(
    "50 % of <b> & |x|", ("Name_1", "v ↑"), ((Cell("a|b_c*<i>&"), Cell("1", "best", "[0, 2]")),), ("a $note#",)
)


def test_html_is_well_formed_and_escapes():
    root = ElementTree.fromstring(to_html(NASTY))
    assert root.find("caption/b").text == NASTY.caption
    assert root.find("tbody/tr/th").text == "a|b_c*<i>&"
    assert root.find("tbody/tr/td/strong").text == "1"


def test_markdown_has_the_same_number_of_cells_in_every_line():
    lines = [line for line in to_markdown(NASTY).splitlines() if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in lines} == {3}
    assert "**1** [0, 2]" in lines[2]


def test_latex_leaves_no_special_character_bare():
    text = to_latex(NASTY)
    body = text.split(r"\midrule")[1]
    assert r"a|b\_c*<i>\& & \textbf{1} {\scriptsize [0, 2]} \\" in body
    assert r"50 \% of <b> \& |x|" in text
    assert text.count(r"\begin{") == text.count(r"\end{")
    assert r"v $\uparrow$" in text
