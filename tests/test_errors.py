"""Errors that a user can fix."""

import pytest

from tidefield.errors import RunError, need


def test_a_library_that_is_missing_is_named_with_its_extra():
    assert need("json.decoder", "view").__name__ == "json.decoder"
    expected = r"^this needs nothing, which cannot be imported .*pip install 'tidefield\[view\]'`$"
    with pytest.raises(RunError, match=expected):
        need("nothing.at_all", "view")
