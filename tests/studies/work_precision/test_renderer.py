"""What a renderer leaves out has an error, and leaving out nothing has none."""

import pytest

from neural_sim.studies.work_precision.measurement import Timing
from neural_sim.studies.work_precision.renderer import Renderer, left_out, variants


@pytest.fixture(scope="module")
def measured(small_world):
    family = Renderer(size=16, views=2, terminations=(0.3,), steps=(2.0,))
    return {series.name: series for series in family.measure(small_world, Timing(1), 0)}


def test_undoing_an_omission_costs_no_error_and_more_of_what_was_left_out(small_world, measured):
    assert set(measured) == {"renderer/opacity", "renderer/colour"}
    for series in measured.values():
        error = {point.setting: point.error for point in series.points}
        # What transmittance below 1e-3 hides is at most that: of opacity, and of colours in [0, 1].
        assert 0.0 < error["quality, final"] <= 1e-3
        assert error["undone, every sample"] < 1e-6  # float32
        assert error["undone, every pixel"] == error["undone, every step"] == error["quality, final"]
        assert error["termination, 0.3"] > error["quality, normal"] > error["quality, final"]
        assert error["step, 2"] > error["quality, final"]
        assert [point.setting for point in series.points if point.default] == ["quality, final"]
    views = small_world.views
    named = variants(small_world.renderer, (), ())
    found = {
        name: left_out(small_world.fields[0], one, views.camera, views.camera_to_world[-2:])
        for name, one in named.items()
    }
    assert found["undone, every pixel"].cast == 1.0 > found["quality, final"].cast
    assert (
        found["undone, every sample"].samples
        > found["quality, final"].samples
        > found["quality, draft"].samples
    )


def test_bad_sizes_name_their_key():
    with pytest.raises(ValueError, match=r"Renderer\.views: want at least 1"):
        Renderer(views=0)
