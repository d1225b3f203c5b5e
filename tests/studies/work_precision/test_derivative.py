"""Every way to the derivative leads to one number, which differences of renders at fixed samples confirm."""

import pytest

from neural_sim.studies.work_precision.derivative import Derivative, case, difference, forward, reverse
from neural_sim.studies.work_precision.measurement import Timing


@pytest.fixture(scope="module")
def measured(small_world):
    family = Derivative(size=16, numbers=(1, 12), patches=(40,), steps=(1e-2, 1e-4))
    return list(family.measure(small_world, Timing(1), 0))


def test_forward_reverse_and_patches_agree_in_float32_and_differences_converge(measured):
    assert [series.name for series in measured] == ["derivative/by 1", "derivative/by 12"]
    for series in measured:
        error = {point.setting: point.error for point in series.points}
        exact = [name for name in error if name.startswith(("forward", "reverse"))]
        assert set(exact) == {
            "forward",
            "forward, chunks of 512 rays",
            "reverse, patches of 40",
            "reverse, whole",
        }
        # 256 pixels of some 10 samples: rounding of float32, 6e-8, times a few thousand terms that do not cancel.
        assert all(error[name] < 2e-4 for name in exact)
        assert error["differences in float64, 0.0001"] < 0.05 * error["differences in float64, 0.01"]
        assert [point.setting for point in series.points if point.default] == ["forward"]


def test_the_reference_is_the_derivative_of_the_image_at_fixed_samples(small_world):
    """Central differences err by h^2 and by rounding, eps / h; both below 1e-6 between 1e-4 and 1e-6."""
    of = case(small_world.fields[0], small_world.renderer, 16, 3).double()
    truth = reverse(of, 256)
    for h in (1e-5, 1e-6):
        assert float((difference(of, h, same=True) - truth).norm() / truth.norm()) < 1e-6
    # The camera's matrix was rounded to float32, so that it is a rotation to 6e-8 only.
    assert float((forward(of) - truth).norm() / truth.norm()) < 1e-6
    assert float((reverse(of, 30) - truth).norm() / truth.norm()) < 1e-12


def test_bad_settings_name_their_key():
    for wrong in ({"numbers": (13,)}, {"steps": (0.0,)}, {"size": 0}):
        with pytest.raises(ValueError, match=r"Derivative\."):
            Derivative(**wrong)
