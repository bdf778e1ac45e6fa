"""The viewer: rays meet the right texels, its page shows the textures the right way up."""

from __future__ import annotations

import asyncio
import sys
import time
import urllib.request
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import viser
from support.browser import SECONDS, Browser
from support.helpers import memory_capture, posed, render_ball, write_scene
from support.unseen import blind
from websockets.sync.client import connect

from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import describe, make_sensor
from svu_mi.capture.tonemap import srgb
from svu_mi.capture.tonemap import tone_mapped as exposed
from svu_mi.cli.main import main
from svu_mi.cli.view import View
from svu_mi.errors import OptionError, ShapeError, SvuEnvironmentError
from svu_mi.geometry.texels import texels
from svu_mi.output.surface_maps import surface_maps
from svu_mi.output.viewer import viser_mesh
from svu_mi.output.viewer.picking import Picker, nearest_texel, texel_markdown
from svu_mi.output.viewer.viewer import PHOTOGRAPH, Viewer
from svu_mi.output.viewer.viser_mesh import LIGHT_STRENGTH, before_tone_mapping, frustum
from svu_mi.pipeline import estimate
from svu_mi.recovery.svbrdf_textures import Textures

SIZE = (40, 24)  # texels: not square, so that rows cannot pass for columns
FILM = (48, 36)
TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
SIDEWAYS = 4  # the view that is least from above


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A ball from above only, so that much of it is unseen; one lens is shifted."""
    light = {"type": "constant", "id": "light"}
    paint = {"type": "principled", "base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}}
    shot = render_ball(tmp_path_factory.mktemp("ball"), light, paint, 12, FILM, 4)
    sensors = list(shot.sensors[:5])
    shifted = {**describe(sensors[2]), "principal_point_offset": [0.2, -0.1]}
    sensors[2] = make_sensor(shifted, "shifted")
    images = [*shot.images[:5]]
    images[2] = np.array(mi.render(shot.scene, sensor=sensors[2], spp=4))[..., :3]
    used = (True, False, True, True, True)
    return memory_capture(shot.scene, images, sensors, used=used)


@pytest.fixture(scope="module")
def known(capture):
    return estimate(capture, texels(capture.mesh, SIZE), preset="fast")


@pytest.fixture(scope="module")
def picker(capture, known):
    return Picker(capture, known)


@pytest.fixture(scope="module")
def quarters():
    """Textures whose four quarters differ: u to the right, v downwards."""
    color = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    half = SIZE[1] // 2, SIZE[0] // 2
    color[: half[0], : half[1]] = 0.7, 0.1, 0.1
    color[: half[0], half[1] :] = 0.1, 0.6, 0.1
    color[half[0] :, : half[1]] = 0.1, 0.1, 0.7
    color[half[0] :, half[1] :] = 0.5, 0.5, 0.1
    ones = mi.TensorXf(np.full((SIZE[1], SIZE[0], 1), 0.25, np.float32))
    return Textures(base_color=mi.TensorXf(color), roughness=ones, metallic=ones)


@pytest.mark.slow
def test_rays_meet_the_texel_that_they_are_aimed_at(known, picker):
    """From anywhere above its face, for a ball hides nothing else; away from it nothing is met."""
    random, grid = np.random.default_rng(740_219), known.texels
    place = np.stack([grid.index.numpy() % SIZE[0], grid.index.numpy() // SIZE[0]], axis=-1)
    points, normals = np.array(grid.position).T, np.array(grid.geometric_normal).T
    for texel in random.choice(grid.count, 60, replace=False):
        aside = np.cross(normals[texel], random.normal(size=3))
        origin = points[texel] + 2 * normals[texel] + random.uniform(0, 3) * aside
        pick = picker.pick(origin, 5 * (points[texel] - origin))
        assert (pick.texel, pick.column, pick.row) == (texel, *place[texel])
        assert picker.pick(origin, normals[texel]) is None


def test_a_pick_equals_the_estimate(capture, known, picker):
    entropy, coverage = np.array(known.entropy), np.array(known.coverage)
    best, position = known.posterior.map(), np.array(known.texels.position)
    means = {name: known.posterior.mean(name).numpy() for name in best}
    intervals = {name: known.posterior.interval(name) for name in best}
    for texel in (0, int(coverage.argmax()), known.texels.count - 1):
        pick = picker.describe(texel)
        assert pick.entropy == entropy[texel]
        assert len(pick.seen_by) == coverage[texel]
        assert np.array_equal(pick.position, position[:, texel])
        assert list(pick.summaries) == (list(best) if coverage[texel] else [])
        for name, told in pick.summaries.items():
            truth = (best[name].numpy(), means[name], *(end.numpy() for end in intervals[name]))
            for one, of_all in zip(told, truth, strict=True):
                assert np.array_equal(one.astype(np.float32), np.atleast_1d(of_all[texel]))
    with pytest.raises(OptionError, match=f"0 to {known.texels.count - 1}, got -1"):
        picker.describe(-1)


def test_a_pick_computes_the_intervals_of_its_texel_only(known, picker, monkeypatch):
    """Those of all texels took three quarters of the time until the page was served."""
    asked, posterior = [], type(known.posterior)
    whole = posterior.interval

    def interval(self, name, level, chosen):
        asked.append((name, *chosen))
        return whole(self, name, level, chosen)

    monkeypatch.setattr(posterior, "interval", interval)
    texel = int(np.array(known.coverage).argmax())
    picker.describe(texel)
    assert asked == [(name, texel) for name in known.posterior.axes]


def test_the_panel_shows_mean_and_interval_of_every_channel(capture, known):
    colored = estimate(capture, known.texels)
    texel = int(np.array(known.coverage).argmax())
    text = texel_markdown(capture, Picker(capture, colored).describe(texel))
    text = text.replace("\u00a0", " ").replace("\u2060", "")
    for name in ("roughness", "metallic", "base_color"):
        mean = np.atleast_1d(colored.posterior.mean(name).numpy()[texel])
        low, high = (np.atleast_1d(end.numpy()[texel]) for end in colored.posterior.interval(name))
        channels = ("base colour R", "base colour G", "base colour B")
        for k, label in enumerate(channels if len(mean) == 3 else (name,)):
            assert f"| {label} | **{mean[k]:.2f}** | {low[k]:.2f}–{high[k]:.2f} |" in text
    assert text.count("base colour") == 3 and "90 % interval" in text


def test_seen_by_numbers_the_views_of_the_capture(capture, known, picker):
    """View 1 is left out: the estimate's second view is the capture's third. A ball hides nothing
    but what faces away."""
    points, compared = np.array(known.texels.position).T, 0
    for texel in range(0, known.texels.count, 23):
        pick = picker.describe(texel)
        assert 1 not in pick.seen_by
        for view in (0, 3, 4):
            towards = to_world(capture.sensors[view])[:3, 3] - points[texel]
            cosine = points[texel] @ towards / np.linalg.norm(towards)
            if not -0.1 < cosine < 0.6:  # pixels near the silhouette show what is beside it, too
                assert (view in pick.seen_by) == (cosine > 0)
                compared += 1
    assert compared > 60


def test_an_unseen_texel_is_grey_and_has_the_prior(capture, known, picker):
    unseen = int(np.flatnonzero(np.array(known.coverage) == 0)[0])
    pick = picker.describe(unseen)
    assert not pick.summaries
    assert "not seen by any of 4 views" in texel_markdown(capture, pick)
    assert "* no information" in texel_markdown(capture, pick)
    for name in ("entropy", "coverage", "most probable base colour", "entropy of metallic"):
        colors = surface_maps(known)[name].colors(np.inf)
        assert np.allclose(colors[pick.row, pick.column], (0.55, 0.55, 0.58))


def test_maps_reach_over_all_that_is_outside_the_charts(known, quarters):
    """What is drawn anywhere is the nearest texel's, which is what a click there finds."""
    table = nearest_texel(known.texels)
    assert (table >= 0).all()
    colors = surface_maps(known)["entropy"].colors(np.inf)
    own = colors.reshape(-1, 3)[known.texels.index.numpy()]
    assert np.array_equal(colors, own[table])
    shown = surface_maps(known, quarters)["recovered base colour"]
    assert shown.scale is None
    assert np.allclose(shown.colors(), srgb(np.array(quarters.base_color)))
    with pytest.raises(ShapeError, match="textures have"):
        surface_maps(replace(known, texels=texels_of_another_size(known)), quarters)


def texels_of_another_size(known):
    return replace(known.texels, resolution=(SIZE[1], SIZE[0]))


def test_a_frustum_is_opencv_with_its_axis_in_the_middle(capture):
    """A point's pixel by Mitsuba's own projection is where the frustum's picture has it."""
    for view in (0, 2):
        camera, sensor = frustum(capture, view, max(FILM)), capture.sensors[view]
        point = np.array([0.3, 0.4, -0.2])
        it = mi.Interaction3f()
        it.p = mi.Point3f(point.tolist())
        sample, _ = sensor.sample_direction(it, mi.Point2f(0.5))
        x, y, z = camera.rotation.T @ (point - camera.position)
        height, width = camera.image.shape[:2]
        focal = height / 2 / np.tan(camera.fov / 2)
        pixel = np.array([width / 2 + focal * x / z, height / 2 + focal * y / z])
        corner = np.argwhere(camera.image[..., 3] > 0).min(axis=0)[::-1]
        # Photographs are widened by whole pixels.
        assert np.abs(pixel - corner - np.array(sample.uv).ravel()).max() < 0.76
        assert camera.aspect == pytest.approx(width / height, rel=0.02)
    photograph = exposed(capture.images[0])
    assert np.abs(frustum(capture, 0, 99).image[..., :3] / 255 - photograph).max() < 0.01


def tone_mapped(linear):
    """The linear colours (..., 3) that three.js shows for linear radiance (..., 3)."""
    x = (linear / viser_mesh.EXPOSURE) @ viser_mesh.TO_ACES.T
    curve = (x * (x + viser_mesh.B) - viser_mesh.C) / (
        x * (viser_mesh.D * x + viser_mesh.E) + viser_mesh.F
    )
    return np.clip(curve @ viser_mesh.FROM_ACES.T, 0, 1)


def test_tone_mapping_is_undone():
    """Greys and muted colours; the brightest and purest are beyond the curve's reach."""
    random = np.random.default_rng(118_340)
    colors = np.concatenate([np.full((9, 3), 0.09) * np.arange(9)[:, None],
                             0.2 + 0.3 * random.random((50, 3))])  # fmt: skip
    assert np.abs(tone_mapped(LIGHT_STRENGTH * before_tone_mapping(colors)) - colors).max() < 2e-3


def page(url):
    with urllib.request.urlopen(url, timeout=10) as answer:
        return answer.read().decode()


def test_a_page_is_served_here_alone_until_interrupted(capture, known, quarters, capfd):
    viewer = Viewer(capture, known, quarters, port=0, up="z")
    assert viewer.url.startswith("http://127.0.0.1:")
    assert "<html" in page(viewer.url)
    address, version = viewer.url.replace("http", "ws"), f"viser-v{viser.__version__}"
    with connect(address, subprotocols=[version], max_size=None) as socket:
        socket.recv()
    assert "recovered roughness" in viewer.maps
    viewer.pick((0, 5, 0), (0, -1, 0))
    assert viewer.picked.position[1] > 0.9
    before = viewer.picked
    viewer.pick((0, 5, 0), (0, 1, 0))  # away from the object
    assert viewer.picked is before
    for view in (2, None):
        viewer.look_through(view)
    viewer._tasks.put(lambda: viewer.show("coverage"))
    viewer._tasks.put(_interrupt)
    viewer.run()
    assert list(viewer._shown) == ["entropy", "coverage"]
    with pytest.raises(OSError, match="refused"):
        page(viewer.url)
    assert capfd.readouterr().out == ""


def test_a_world_with_z_up_and_no_visible_texel(capture, known):
    turned = posed(capture, *(TO_Z_UP @ to_world(sensor) for sensor in capture.sensors))
    viewer = Viewer(turned, blind(known), port=0)
    try:
        np.testing.assert_array_equal(viewer._up, [0, 0, 1])
        heading = viewer._status.content
        assert "mean entropy 1.00" in heading and "0\u202f% seen" in heading
        assert viewer._server.initial_camera.position[2] > 0.5  # from above
    finally:
        viewer.stop()


def _interrupt():
    raise KeyboardInterrupt


def test_what_a_browser_does_becomes_a_task_and_what_the_program_does_none(
    capture, known, monkeypatch
):
    heard = {}
    for kind in (viser.GuiDropdownHandle, viser.GuiCheckboxHandle, viser.GuiSliderHandle):
        monkeypatch.setattr(kind, "on_update", lambda self, work: heard.update({self.label: work}))
    frustum_of = viser.CameraFrustumHandle
    monkeypatch.setattr(frustum_of, "on_click", lambda self, work: heard.update({self.name: work}))
    monkeypatch.setattr(viser.SceneApi, "on_click", lambda _: partial(heard.setdefault, "click"))
    viewer = Viewer(capture, known, port=0)
    try:
        camera = SimpleNamespace(aspect=1.0)
        page = SimpleNamespace(camera=camera)
        above = {"ray_origin": (0, 5, 0), "ray_direction": (0, -1, 0)}

        def happens(name, at=(0, 0), client=page):
            event = SimpleNamespace(client=client, screen_pos=at, **above)
            asyncio.run(heard[name](event))
            return viewer.work(0)

        viewer._choice.value = "coverage"
        assert not happens("map", client=None)
        assert happens("map") and list(viewer._shown) == ["entropy", "coverage"]
        viewer._cameras.value = False
        assert happens("show") and not any(each.visible for each in viewer._frusta)
        viewer._through.value = capture.names[SIDEWAYS]
        assert happens("look from")
        np.testing.assert_allclose(camera.position, to_world(capture.sensors[SIDEWAYS])[:3, 3])
        assert not viewer._plot.visible
        viewer._opacity.value = viewer._opacity.max  # nothing shows through the photograph
        assert happens("photograph")
        photograph = frustum(capture, SIDEWAYS, PHOTOGRAPH).image
        np.testing.assert_array_equal(viewer._frusta[SIDEWAYS].image, photograph)
        assert happens("/cameras/0000", at=(3, 4))
        np.testing.assert_allclose(camera.position, to_world(capture.sensors[0])[:3, 3])
        assert happens("click", at=(3, 4)) and viewer.picked is None  # the same click, on a camera
        assert happens("/cameras/0000", at=(5, 6)) and happens("click", at=(5, 6))
        assert viewer.picked.position[1] > 0.9 and viewer._plot.visible
    finally:
        viewer.stop()


def test_bad_ports_and_a_missing_viser_are_one_sentence(capture, known, monkeypatch):
    with pytest.raises(OptionError, match="--port must be 0 to 65535, got 65536"):
        Viewer(capture, known, port=65536)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SvuEnvironmentError, match=r"pip install 'svu_mi\[viewer\]'"):
        Viewer(capture, known)


def test_command_line(tmp_path, monkeypatch, capsys, variant):
    scene, urls = write_scene(tmp_path), []
    monkeypatch.setattr(Viewer, "run", lambda self: (urls.append(page(self.url)), self.stop()))
    words = ["view", str(scene), "--port", "0", "--resolution", "16", "--render", "--spp", "2"]
    assert main([*words, "-o", str(tmp_path / "out")]) == 0
    assert "<html" in urls[0]
    assert "Open http://127.0.0.1:" in capsys.readouterr().out
    assert main([*words, "--recovered", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err
    with monkeypatch.context() as patch:
        patch.setattr(View, "load_with_light", None)  # refused before any work
        assert main(["view", str(scene), "--port", "65536"]) == 2
    assert "--port must be" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(words) == 2
    assert "svu: The viewer needs viser" in capsys.readouterr().err
    mi.set_variant(variant)


@pytest.mark.slow
def test_a_browser_shows_what_mitsuba_renders(capture, known, quarters, tmp_path):
    """Axes of cameras, of the texture and of its colours, all at once; and the way of a click."""
    viewer = Viewer(capture, known, quarters, port=0)
    browser = Browser(tmp_path, "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
    try:
        viewer.show("recovered base colour")
        page = browser.open(viewer.url, 760, 240)  # the panel is on the right
        shown = _shown(viewer, frustum(capture, SIDEWAYS, 8))
        eye = _click_the_middle(viewer, page)
        requests = page.requests
    finally:
        browser.close()  # first: a server with an open page takes seconds to stop
        viewer.stop()
    color, valid = _colors_seen(capture, quarters)
    assert valid.mean() > 0.2
    assert len(np.unique(color[valid], axis=0)) >= 2  # quarters: what a flip would exchange
    right = np.abs(shown[..., :3] - color).max(axis=2) < 0.13  # light from below is weaker
    # Borders of quarters and the silhouette are smoothed.
    assert right[valid].mean() > 0.9
    assert (shown[..., 3] > 0.5)[~valid].mean() < 0.03
    # The camera looks at the ball's centre: what is nearest to it is in the middle.
    assert viewer.picked.position @ eye / np.linalg.norm(eye) > 0.97
    assert all(request.startswith(viewer.url) for request in requests)


def _click_the_middle(viewer, page):
    """Click, let the viewer answer, and return where the page's camera is."""
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        page.ask("Input.dispatchMouseEvent", type=kind, x=380, y=120, button="left", clickCount=1)
    while viewer.picked is None:
        assert viewer.work(10), "the click does not arrive"
    (client,) = viewer._server.get_clients().values()
    return np.array(client.camera.position)


def _shown(viewer, camera):
    """What the browser shows from a camera, (H, W, 4)."""
    from viser.transforms import SO3

    deadline = time.monotonic() + SECONDS
    while not viewer._server.get_clients():
        assert time.monotonic() < deadline, "no browser has connected"
        time.sleep(0.05)
    (client,) = viewer._server.get_clients().values()
    viewer._cameras.value = False
    viewer._update_frusta()
    while True:  # the model arrives some time after the page
        assert time.monotonic() < deadline, "the browser shows nothing"
        shown = client.get_render(
            FILM[1], FILM[0], wxyz=SO3.from_matrix(camera.rotation).wxyz,
            position=camera.position, fov=camera.fov, transport_format="png",
        )  # fmt: skip
        if shown[..., 3].any():
            return shown / 255
        time.sleep(0.1)


def _colors_seen(capture, textures):
    """Unshaded screen colours (H, W, 3) at the pixels' centres, from rays of Mitsuba's; and where
    these hit."""
    rows, columns = np.mgrid[: FILM[1], : FILM[0]].reshape(2, -1)
    place = mi.Point2f((columns + 0.5) / FILM[0], (rows + 0.5) / FILM[1])
    ray, _ = capture.sensors[SIDEWAYS].sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    hit = capture.scene.ray_intersect(ray)
    u, v = np.array(hit.uv)
    column, row = (np.clip(x * n, 0, n - 1).astype(int) for x, n in zip((u, v), SIZE, strict=True))
    color = srgb(np.array(textures.base_color))[row, column]
    return color.reshape(FILM[1], FILM[0], 3), np.array(hit.is_valid()).reshape(FILM[1], FILM[0])
