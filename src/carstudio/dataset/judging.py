"""Judging a whole store: every patch by its own values, and repeated pictures by those before them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from carstudio.dataset.duplicates import require_duplicates
from carstudio.dataset.filters import FilterRecipe, judge
from carstudio.dataset.store import PatchStore
from carstudio.dataset.verdicts import Check, Verdict

DUPLICATE = "duplicate"  # the filter's name


def judge_store(store: PatchStore, recipe: FilterRecipe) -> None:
    """Judge every patch again by its stored values and replace the store's verdicts.

    `InputError` when repeated pictures shall be dropped and nobody has looked for them.
    """
    verdicts: Iterable[Verdict] = (judge(record, recipe) for record in store.light_records())
    if recipe.drop_duplicates:
        verdicts = drop_repeats(verdicts, require_duplicates(store).firsts())
    store.write_verdicts(verdicts)


def drop_repeats(verdicts: Iterable[Verdict], firsts: Mapping[str, str]) -> Iterator[Verdict]:
    """Of the patches that repeat one picture keep the first that passes all other filters; verdicts in store order.

    `firsts` leads from a patch to the earlier one that it repeats.
    """
    has_kept: set[str] = set()
    for verdict in verdicts:
        picture = firsts.get(verdict.patch_id, verdict.patch_id)
        is_repeat = verdict.is_kept and picture in has_kept
        checks = (*verdict.checks, Check(DUPLICATE, None, None, not is_repeat))
        if is_repeat:
            yield replace(verdict, is_kept=False, reason=DUPLICATE, failed=(DUPLICATE,), checks=checks)
            continue
        if verdict.is_kept:
            has_kept.add(picture)
        yield replace(verdict, checks=checks)
