"""Choosing a renderer: the fall-back is taken, and said."""

import logging
import math

import pytest
import torch

from neural_sim.cameras import orbit
from neural_sim.objects.procedural import Procedural
from neural_sim.renderer import views
from neural_sim.renderer.lighting import Lighting
from neural_sim.renderer.raycast import RaycastRenderer
from neural_sim.types import PinholeCamera


@pytest.fixture
def no_opengl(monkeypatch):
    monkeypatch.setattr(views, "opengl_platform", lambda: None)


def test_without_opengl_ray_casting_takes_over_and_says_so(no_opengl, caplog):
    light = Lighting(ambient=0.2)
    with caplog.at_level(logging.WARNING):
        renderer = views.choose_mesh_renderer("auto", 3, light)
    assert isinstance(renderer, RaycastRenderer)
    assert renderer.supersample == 3 and renderer.lighting == light
    assert "ray casting" in caplog.text


def test_pyrender_demanded_without_opengl_is_an_error_of_that_key(no_opengl, monkeypatch):
    for platform, tried in ((None, "egl or osmesa"), ("glx", "glx")):
        monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
        if platform is not None:
            monkeypatch.setenv("PYOPENGL_PLATFORM", platform)
        with pytest.raises(
            ValueError, match=f"^views.backend=pyrender: OpenGL cannot draw with {tried}; want"
        ):
            views.choose_mesh_renderer("pyrender")


def test_a_platform_that_fails_is_passed_over(monkeypatch, caplog):
    monkeypatch.setattr(
        views, "PROBE", "import sys, os; sys.exit(os.environ['PYOPENGL_PLATFORM'] + ' is broken')"
    )
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    with caplog.at_level(logging.INFO):
        assert views.opengl_platform.__wrapped__() is None
    assert "egl failed: egl is broken" in caplog.text and "osmesa is broken" in caplog.text


def test_second_choice_is_osmesa_and_the_users_variable_wins(monkeypatch):
    monkeypatch.setattr(
        views, "PROBE", "import os; raise SystemExit(os.environ['PYOPENGL_PLATFORM'] == 'egl')"
    )
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    assert views.opengl_platform.__wrapped__() == "osmesa"
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    assert views.opengl_platform.__wrapped__() is None


def test_posed_views_carry_their_cameras():
    camera = PinholeCamera(24, 24, math.radians(40.0))
    poses = orbit(torch.tensor([0.3, 2.0]), torch.tensor([0.0, 0.5]), torch.tensor([3.0, 3.5]))
    posed = views.render_views(RaycastRenderer(1), Procedural(["mug"]).load()[0], camera, poses)
    assert len(posed) == 2 and posed.images.shape == (2, 24, 24, 4) and posed.images.dtype == torch.float32
    assert posed.camera is camera and posed.camera_to_world is poses
    assert posed.images.min() >= 0.0 and posed.images.max() <= 1.0 and posed.images[..., 3].mean() > 0.05
