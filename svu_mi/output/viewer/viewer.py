"""Viewer: an object with its maps, cameras and posterior in a browser.

viser serves a page on 127.0.0.1 from its own threads. User input becomes a task in a queue that one
thread processes, so that Dr.Jit runs in a single thread and Ctrl-C ends the viewer.
"""

import queue
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.image_io import srgb
from svu_mi.capture.sensors import bounding_sphere
from svu_mi.capture.up_direction import up_direction
from svu_mi.core.identifiers import markdown_text
from svu_mi.errors import counted
from svu_mi.output.estimate_arrays import is_seen
from svu_mi.output.html import percent
from svu_mi.output.interval_summary import Intervals
from svu_mi.output.object_views import DIRECTION, Axis, front_and_right
from svu_mi.output.style import MARK
from svu_mi.output.surface_maps import surface_maps
from svu_mi.output.viewer.access_control import serve, stop
from svu_mi.output.viewer.picking import Pick, Picker, draw_pick, draw_scale, texel_markdown
from svu_mi.output.viewer.viser_mesh import (
    LIGHT_STRENGTH,
    Frustum,
    frustum,
    material_colors,
    textured_mesh,
)
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty.texture_field import field_of_textures

HOME = (2.2, 1.2, 0.8)  # initial camera: front, right, up, in radii from the centre
NOWHERE = "anywhere"  # menu entry for a free camera
THUMBNAIL, PHOTOGRAPH = 160, 1024  # pixels of the longer side
CAMERA, SEEING = (70, 70, 80), tuple(round(255 * c) for c in MARK)  # colours of frusta
CAMERA_SIZE = 0.12  # relative to the object's radius
SHADE = 0.75  # brightness of downward faces, which makes shapes visible
PATIENCE = 0.5  # seconds; a blocking wait would ignore Ctrl-C on some systems


class Viewer:
    """Page with an object, its cameras and its posterior; the constructor opens it.

    Attributes:
        url: Secret address of the page; other requests are refused.
        picked: Last clicked texel, or None.

    Args:
        capture: Capture of the estimate.
        estimate: Estimate returned by ``svu.estimate``.
        recovered: Recovered textures to show, of the same resolution.
        port: Port of the page; if in use, the next free one; 0 takes any free port.
        up: Upward axis of the world; default: derived from the cameras.

    Raises:
        SvuEnvironmentError: viser is not installed, or cannot be protected (see ``serve``).
        OptionError: the port is invalid.
        ShapeError: the textures have another resolution.
    """

    def __init__(
        self,
        capture: Capture,
        estimate: Estimate,
        recovered: Textures | None = None,
        *,
        port: int = 8080,
        up: Axis | None = None,
    ) -> None:
        self._capture, self._estimate, self._recovered = capture, estimate, recovered
        intervals = Intervals(estimate.posterior)
        field = None if recovered is None else field_of_textures(recovered, estimate, capture.mesh)
        self._maps = surface_maps(estimate, recovered, intervals, field)
        self._picker = Picker(capture, estimate)
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._shown: dict[str, Any] = {}
        self._center, self._radius = bounding_sphere(capture.mesh)
        self._up = up_direction(capture) if up is None else np.array(DIRECTION[up])
        front, right = front_and_right(capture, self._center, self._up)
        self._home = np.array(HOME) @ [front, right, self._up]
        # Compile the kernels of the first click now.
        self._picker.pick(self._center, self._up)
        if (seen := np.flatnonzero(is_seen(estimate))).size:
            self._picker.describe(int(seen[0]))
        self.picked: Pick | None = None
        self._view: int | None = None
        self._server, self.url = serve(port)
        self._set_up_scene()
        self._panels()
        self._frusta = [self._add_frustum(view) for view in range(capture.count)]
        self._listen()
        self.show("entropy")

    def run(self) -> None:
        """Process user input until Ctrl-C."""
        try:
            while True:
                self.work(PATIENCE)
        except KeyboardInterrupt:
            return
        finally:
            self.stop()

    def work(self, seconds: float) -> bool:
        """Process the next user input; return False if ``seconds`` pass without one."""
        try:
            task = self._tasks.get(timeout=seconds)
        except queue.Empty:
            return False
        task()
        return True

    def stop(self) -> None:
        """Close the page."""
        stop(self._server)

    def show(self, name: str) -> None:
        """Show a map of ``maps`` on the object."""
        if name not in self._shown:
            self._status.content = f"Computing *{name}* ..."
            # Dilate without limit, so that seams are invisible.
            mesh = textured_mesh(self._capture.mesh, self._maps[name].colors(np.inf))
            self._shown[name] = self._server.scene.add_mesh_trimesh(f"/object/{name}", mesh)
            self._status.content = self._heading()
        for other, handle in self._shown.items():
            handle.visible = other == name
        self._choice.value = name
        scale = self._maps[name].scale
        self._bar.visible = scale is not None
        if scale is not None:
            self._bar.image = draw_scale(scale)

    @property
    def maps(self) -> tuple[str, ...]:
        """Names of the maps."""
        return tuple(self._maps)

    def look_through(self, view: int | None, client: Any | None = None) -> None:
        """Move to a camera and show its photograph over the object; None returns to a free view.

        Without ``client``, all browsers move.
        """
        # Replace the large image of the previous camera by a thumbnail.
        if self._view is not None and view != self._view:
            self._frusta[self._view].image = frustum(self._capture, self._view, THUMBNAIL).image
        self._view = view
        self._through.value = NOWHERE if view is None else self._capture.names[view]
        self._update_frusta()
        camera = None if view is None else frustum(self._capture, view, PHOTOGRAPH)
        self._fade(camera)
        for browser in (client,) if client else self._server.get_clients().values():
            self._move(browser.camera, camera)

    def pick(self, origin: Any, direction: Any) -> None:
        """Show the posterior of the texel that a ray hits; ignore a ray that misses."""
        pick = self._picker.pick(origin, direction)
        if pick is None:
            return
        self.picked = pick
        self._text.content = texel_markdown(self._capture, pick)
        self._plot.image = draw_pick(self._estimate, pick, self._recovered)
        self._plot.visible = True
        red = material_colors(np.array(MARK))
        self._server.scene.add_icosphere(
            "/texel", 0.012 * self._radius, color=tuple(red.tolist()), position=pick.position,
        )  # fmt: skip
        self._update_frusta()

    def _set_up_scene(self) -> None:
        scene, camera = self._server.scene, self._server.initial_camera
        scene.set_up_direction(self._up)
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        ground = round(255 * float(srgb(np.array(SHADE))))
        scene.add_light_hemisphere(
            "/light", sky_color=(255, 255, 255), ground_color=(ground,) * 3,
            intensity=LIGHT_STRENGTH * np.pi,
        )  # fmt: skip
        camera.near, camera.far = 1e-3 * self._radius, 1e3 * self._radius
        camera.position = self._center + self._radius * self._home
        camera.look_at, camera.fov = self._center, np.radians(45)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)

    def _panels(self) -> None:
        gui = self._server.gui
        self._status = gui.add_markdown(self._heading())
        with gui.add_folder("Surface"):
            self._choice = gui.add_dropdown("map", self.maps)
            self._bar = gui.add_image(draw_scale(None), format="png")
        with gui.add_folder("Cameras"):
            self._cameras = gui.add_checkbox("show", True)
            self._size = gui.add_slider("size", 0.2, 5, 0.1, 1)
            self._through = gui.add_dropdown("look from", (NOWHERE, *self._capture.names))
            self._opacity = gui.add_slider("photograph", 0, 1, 0.05, 0.5, visible=False)
        with gui.add_folder("Texel"):
            self._text = gui.add_markdown("Click the object.")
            self._plot = gui.add_image(draw_scale(None), format="png", visible=False)

    def _heading(self) -> str:
        seen = is_seen(self._estimate)
        entropy = np.array(self._estimate.entropy)
        mean = (entropy[seen] if seen.any() else entropy).mean()
        tested, sentence = self._estimate.prediction, self._estimate.prediction_sentence
        wrong = "" if tested is None or tested.reliable else f" {sentence}"
        return (
            f"**{markdown_text(self._capture.shape.id())}**: "
            f"{counted(sum(self._capture.used), 'view')}, "
            f"{self._estimate.texels.count} texels, {percent(seen.mean())} seen, mean entropy "
            f"{mean:.2f}. Grey: never seen.{wrong}"
        )

    def _listen(self) -> None:
        """Turn viser's events into tasks; handlers are coroutines, which viser runs in order."""

        def later(work: Callable[[Any], None]) -> Callable[[Any], Any]:
            async def put(event: Any) -> None:
                if event.client is not None:  # ignore changes by this program
                    self._tasks.put(lambda: work(event))

            return put

        self._choice.on_update(later(lambda _: self.show(self._choice.value)))
        self._through.on_update(later(self._choose))
        for widget in (self._cameras, self._size):
            widget.on_update(later(lambda _: self._update_frusta()))
        self._opacity.on_update(later(lambda _: self._fade()))
        self._taken: tuple[float, float] | None = None  # last click handled by a frustum
        self._server.scene.on_click()(later(self._click))
        for view, handle in enumerate(self._frusta):
            handle.on_click(later(partial(self._enter, view)))

    def _choose(self, event: Any) -> None:
        view = (NOWHERE, *self._capture.names).index(self._through.value) - 1
        self.look_through(None if view < 0 else view, event.client)

    def _click(self, event: Any) -> None:
        if event.screen_pos != self._taken:
            self.pick(event.ray_origin, event.ray_direction)

    def _enter(self, view: int, event: Any) -> None:
        if view != self._view:  # clicks on the shown photograph are meant for the object
            self._taken = event.screen_pos
            self.look_through(view, event.client)

    def _add_frustum(self, view: int) -> Any:
        from viser.transforms import SO3

        camera = frustum(self._capture, view, THUMBNAIL)
        return self._server.scene.add_camera_frustum(
            f"/cameras/{view:04d}", camera.fov, camera.aspect, image=camera.image, color=CAMERA,
            scale=CAMERA_SIZE * self._radius, thickness=1.5, thickness_units="screen",
            wxyz=SO3.from_matrix(camera.rotation).wxyz, position=camera.position,
        )  # fmt: skip

    def _update_frusta(self) -> None:
        """Hide cameras while another one is shown; mark the cameras that see the picked texel."""
        seeing = self.picked.seen_by if self.picked else ()
        for view, handle in enumerate(self._frusta):
            handle.visible = self._cameras.value if self._view is None else view == self._view
            handle.color = SEEING if view in seeing else CAMERA
            handle.scale = CAMERA_SIZE * self._radius * self._size.value
        self._opacity.visible = self._view is not None

    def _fade(self, camera: Frustum | None = None) -> None:
        if self._view is not None:
            image = (camera or frustum(self._capture, self._view, PHOTOGRAPH)).image
            opacity = np.array([1, 1, 1, self._opacity.value])
            self._frusta[self._view].image = (image * opacity).astype(np.uint8)

    def _move(self, camera: Any, to: Frustum | None) -> None:
        """Move a browser's camera to a frustum and show its whole picture; None: initial camera."""
        if to is None:
            home = self._server.initial_camera
            camera.position, camera.look_at, camera.fov = home.position, home.look_at, home.fov
            camera.up_direction = self._up
            return
        forward = to.rotation[:, 2]
        ahead = max(float((self._center - to.position) @ forward), 0.1 * self._radius)
        camera.position, camera.look_at = to.position, to.position + ahead * forward
        camera.up_direction = -to.rotation[:, 1]
        camera.fov = 2 * np.arctan(np.tan(to.fov / 2) * max(1.0, to.aspect / camera.aspect))
