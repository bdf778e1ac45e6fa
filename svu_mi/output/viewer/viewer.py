"""The viewer: an object and all that is known of it, in a browser.

viser serves a page to 127.0.0.1 from threads of its own. What a user does there becomes a task in
a queue, and one thread works it off: nothing of Dr.Jit runs anywhere else, and Ctrl-C ends it.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.image_io import srgb
from svu_mi.capture.sensors import bounding_sphere
from svu_mi.core.identifiers import obj_name
from svu_mi.output.estimate_arrays import is_seen
from svu_mi.output.html import percent
from svu_mi.output.interval_summary import Intervals
from svu_mi.output.object_views import DIRECTION, Axis, front_and_right, up_direction
from svu_mi.output.style import MARK
from svu_mi.output.surface_maps import surface_maps
from svu_mi.output.viewer.access_control import require_viser, serve, stop
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

HOME = (2.2, 1.2, 0.8)  # in front, to the right and above, in radii: the first look at the object
NOWHERE = "anywhere"
THUMBNAIL, PHOTOGRAPH = 160, 1024  # pixels of the longer side
CAMERA, SEEING = (70, 70, 80), tuple(round(255 * c) for c in MARK)  # colours of frusta
CAMERA_SIZE = 0.12  # in parts of the object's radius
SHADE = 0.75  # brightness of what faces down, so that shapes are seen
PATIENCE = 0.5  # seconds between looks for Ctrl-C, which some systems do not tell a waiting queue


class Viewer:
    """A page with an object, its cameras and its posterior; open from when it is made.

    Attributes:
        url: of the page; its path is a secret, without which nothing is answered.
        picked: the texel clicked last, if any.

    Args:
        capture: the ``Capture``.
        estimate: its ``Estimate``, as ``svu.estimate`` returns it.
        recovered: textures to look at, of the same resolution.
        port: of the page; the next free one if it is taken, any free one if it is 0.
        up: axis of the world that points upwards; None is as the cameras have it.

    Raises:
        SvuEnvironmentError: viser is not installed, or cannot be guarded (see ``serve``).
        OptionError: no port.
        ShapeError: textures of another resolution.
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
        require_viser()  # before any work
        self._capture, self._estimate, self._recovered = capture, estimate, recovered
        intervals = Intervals(estimate.posterior)
        field = None if recovered is None else field_of_textures(recovered, estimate, capture.mesh)
        self._maps = surface_maps(estimate, recovered, intervals, field)
        self._picker = Picker(capture, estimate, intervals)
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._shown: dict[str, Any] = {}
        self._center, self._radius = bounding_sphere(capture.mesh)
        self._up = up_direction(capture) if up is None else np.array(DIRECTION[up])
        front, right = front_and_right(capture, self._center, self._up)
        self._home = np.array(HOME) @ [front, right, self._up]
        # Compile and compute now what the first click needs.
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
        """Do what the page asks for, until Ctrl-C."""
        try:
            while True:
                self.work(PATIENCE)
        except KeyboardInterrupt:
            return
        finally:
            self.stop()

    def work(self, seconds: float) -> bool:
        """Do the next thing that the page asks for; return whether there was one in that time."""
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
        """Show a map on the object; ``maps`` names them."""
        if name not in self._shown:
            self._status.content = f"Computing *{name}* ..."
            # Charts reach over all that is outside, so that no seam shows.
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
        """Names of all that can be shown."""
        return tuple(self._maps)

    def look_through(self, view: int | None, client: Any | None = None) -> None:
        """Go to a camera and see its photograph over the object; None leaves it.

        In the browser ``client``, in all by default.
        """
        if self._view is not None and view != self._view:  # its large picture is of no use there
            self._frusta[self._view].image = frustum(self._capture, self._view, THUMBNAIL).image
        self._view = view
        self._through.value = NOWHERE if view is None else self._capture.names[view]
        self._update_frusta()
        camera = None if view is None else frustum(self._capture, view, PHOTOGRAPH)
        self._fade(camera)
        for browser in (client,) if client else self._server.get_clients().values():
            self._move(browser.camera, camera)

    def pick(self, origin: Any, direction: Any) -> None:
        """Show what is known of the texel that a ray hits; nothing changes if it hits none."""
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
            cast_shadow=False, receive_shadow=False,
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
        # The page takes more than Markdown for its own: an id in braces would be run.
        seen = is_seen(self._estimate)
        entropy = np.array(self._estimate.entropy)  # where nothing is seen, that of the prior
        mean = (entropy[seen] if seen.any() else entropy).mean()
        return (
            f"**{obj_name(self._capture.shape.id())}**: {sum(self._capture.used)} views, "
            f"{self._estimate.texels.count} texels, {percent(seen.mean())} seen, mean entropy "
            f"{mean:.2f}. Grey: never seen."
        )

    def _listen(self) -> None:
        """Turn events into tasks; coroutines, because viser runs those in order."""

        def later(work: Callable[[Any], None]) -> Callable[[Any], Any]:
            async def put(event: Any) -> None:
                if event.client is not None:  # else it was set here
                    self._tasks.put(lambda: work(event))

            return put

        self._choice.on_update(later(lambda _: self.show(self._choice.value)))
        self._through.on_update(later(self._choose))
        for widget in (self._cameras, self._size):
            widget.on_update(later(lambda _: self._update_frusta()))
        self._opacity.on_update(later(lambda _: self._fade()))
        self._taken: tuple[float, float] | None = None  # where a click went to a frustum
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
        if view != self._view:  # else it was meant for what is behind the photograph
            self._taken = event.screen_pos
            self.look_through(view, event.client)

    def _add_frustum(self, view: int) -> Any:
        from viser.transforms import SO3

        camera = frustum(self._capture, view, THUMBNAIL)
        return self._server.scene.add_camera_frustum(
            f"/cameras/{view:04d}", camera.fov, camera.aspect, image=camera.image, color=CAMERA,
            scale=CAMERA_SIZE * self._radius, thickness=1.5, thickness_units="screen",
            wxyz=SO3.from_matrix(camera.rotation).wxyz, position=camera.position,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _update_frusta(self) -> None:
        """Only the camera that is looked through is left; those that see the texel are red."""
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
        """Look from a camera, with a window that may be narrower than its picture; or go home."""
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
