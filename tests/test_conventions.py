"""The worked numbers of docs/conventions.md are true."""

import doctest


def test_the_numbers_on_the_page_are_true(repo_root):
    page = repo_root / "docs" / "conventions.md"
    result = doctest.testfile(str(page), module_relative=False)
    assert result.attempted > 20
    assert result.failed == 0
