"""A mistake of the user is one line that names the place and what was expected."""

import pytest

from p4dgs_ref.scenes import SceneError


def refuse(words, call, *args, **kwargs):
    """Assert that a call raises a SceneError of one line with these words; return its message."""
    with pytest.raises(SceneError) as caught:
        call(*args, **kwargs)
    message = str(caught.value)
    assert "\n" not in message and len(message) < 1500
    assert ".png.png" not in message and ".jpg.png" not in message  # the suffix is added once
    assert [word for word in words if word not in message] == [], message
    return message
