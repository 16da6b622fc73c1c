"""The part of the Compare panel that fits clock and mount to the real images."""

from dataclasses import replace

import numpy as np
from imgui_bundle import ImVec2, imgui

from glstar.viewer.imagefit import FitResult, ImageFit
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
        if comparison.images is None or session.loaded is None:
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
        flight = replace(loaded.simulator.flight, time_offset_s=comparison.ahead_s)
        comparison.fit = ImageFit(
            loaded.simulator.with_flight(flight),
            list(comparison.images),
            session.config.exposure.starting_at(0.0),
            reference=comparison.time_reference,
            own_length=comparison.match_exposure,
            fit_time=self._fits_time,
            fit_mount=self._fits_mount,
        )

    def _draw_result(self, session: Session, result: FitResult) -> None:
        for line in fit_report(result, session.comparison.ahead_s):
            imgui.push_text_wrap_pos(0.0)
            imgui.text_unformatted(line)
            imgui.pop_text_wrap_pos()
        if imgui.button("Apply"):
            alignment = result.alignment
            if alignment.fitted_time:
                session.comparison.offset_s -= alignment.delay_s
            if alignment.fitted_mount:
                session.change(**alignment.mount_keys)
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
    fitted, lines = result.alignment, list[str]()
    if fitted.fitted_time:
        lines.append(f"camera clock - log clock {ahead_s - fitted.delay_s:+.4f} s, to {fitted.delay_std_s:.4f} s")
    if fitted.fitted_mount:
        turn, std = np.rad2deg(fitted.turn_rad), np.rad2deg(fitted.turn_std_rad)
        angles = ", ".join(
            f"{key.removeprefix('mount.').removesuffix('_deg')} {angle:.3f}" for key, angle in fitted.mount_keys.items()
        )
        lines.append(f"mount {angles} deg")
        lines.append(f"turned by {turn[0]:+.3f}, {turn[1]:+.3f}, {turn[2]:+.3f} deg, to {std.max():.3f} deg")
    lines.append(f"{result.images} of {result.of} images, {fitted.stars} stars")
    centroid = result.summary["centroid"]
    lines.append(f"centroids {centroid['mean_px']:.2f} px apart on average, {centroid['median_px']:.2f} px median")
    return [*lines, *fitted.notes]
