"""The part of the Compare panel that fits clock and mount to the real images."""

from dataclasses import replace
from math import degrees

from imgui_bundle import ImVec2, imgui

from glstar.viewer.imagefit import FitRequest, FitResult, ImageFit
from glstar.viewer.session import Session
from glstar.viewer.ui.theme import error

__all__ = ["FitPanel"]


class FitPanel:
    """Widgets for an `ImageFit`, drawn into the current imgui window."""

    def __init__(self) -> None:
        self._fits_time = self._fits_mount = True

    def draw(self, session: Session) -> None:
        """Draw the panel; start, stop and apply fits as the user does.

        Parameters
        ----------
        session : Session
        """
        comparison = session.comparison
        if comparison.images is None or session.loaded is None or comparison.fit_images is None:
            return
        imgui.separator_text("Fit to the images")
        fit = comparison.fit
        if fit is not None and fit.running:
            imgui.progress_bar(fit.done / fit.of if fit.of else 0.0, ImVec2(-1, 0), f"{fit.done} of {fit.of} images")
            if imgui.button("Stop fitting"):
                fit.cancel()
            return
        _, self._fits_time = imgui.checkbox("camera clock", self._fits_time)
        imgui.set_item_tooltip("fits camera clock - log clock, as glstar compare --fit-time-offset")
        imgui.same_line()
        _, self._fits_mount = imgui.checkbox("mount", self._fits_mount)
        imgui.set_item_tooltip("fits yaw, pitch and roll of the camera on the aircraft, as glstar compare --fit-mount")
        imgui.begin_disabled(not (self._fits_time or self._fits_mount))
        if imgui.button("Fit"):
            self._start(session)
        imgui.end_disabled()
        imgui.set_item_tooltip("moves star trails onto those of up to 48 images; nothing changes until Apply")
        if fit is not None and fit.error:
            imgui.push_text_wrap_pos(0.0)
            imgui.text_colored(error(), fit.error)
            imgui.pop_text_wrap_pos()
        if fit is not None and fit.result is not None:
            self._draw_result(session, fit.result)

    def _start(self, session: Session) -> None:
        comparison, loaded = session.comparison, session.loaded
        assert comparison.images is not None
        assert loaded is not None
        assert comparison.fit_images is not None
        flight = replace(loaded.simulator.flight, time_offset_s=comparison.ahead_s)
        request = FitRequest(
            loaded.simulator.with_flight(flight),
            tuple(comparison.images),
            session.config.exposure.starting_at(0.0),
            comparison.time_reference,
            comparison.match_exposure,
            self._fits_time,
            self._fits_mount,
        )
        comparison.fit = ImageFit(request, comparison.fit_images)

    def _draw_result(self, session: Session, result: FitResult) -> None:
        for line in fit_report(result, session.comparison.ahead_s):
            imgui.push_text_wrap_pos(0.0)
            imgui.text_unformatted(line)
            imgui.pop_text_wrap_pos()
        if imgui.button("Apply"):
            session.comparison.offset_s += result.clock_change_s or 0.0
            if result.mount_keys:
                session.change(**result.mount_keys)
            session.comparison.fit = None
        imgui.set_item_tooltip("takes the clock and the mount; Ctrl+Z takes back the mount")
        imgui.same_line()
        if imgui.button("Discard"):
            session.comparison.fit = None


def fit_report(result: FitResult, ahead_s: float) -> list[str]:
    """Return what a fit found, as lines.

    Parameters
    ----------
    result : FitResult
    ahead_s : float
        Camera clock minus log clock before the fit, s.

    Returns
    -------
    list of str
    """
    lines = []
    if result.clock_change_s is not None:
        lines.append(
            f"camera clock - log clock {ahead_s + result.clock_change_s:+.4f} s, to {result.clock_std_s:.4f} s"
        )
    if result.mount_keys:
        angles = ", ".join(
            f"{key.removeprefix('mount.').removesuffix('_deg')} {angle:.3f}" for key, angle in result.mount_keys.items()
        )
        turn = ", ".join(f"{degrees(angle):+.3f}" for angle in result.turn_rad)
        lines += [f"mount {angles} deg", f"turned by {turn} deg, to {degrees(max(result.turn_std_rad)):.3f} deg"]
    lines.append(f"{result.images} of {result.of} images, {result.stars} stars")
    distance = f"mean {result.centroid_mean_px:.2f} px, median {result.centroid_median_px:.2f} px"
    return [*lines, f"distance of centroids: {distance}", *result.notes]
