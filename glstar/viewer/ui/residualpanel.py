"""The part of the Compare panel with the paper's measures of the real image shown."""

from imgui_bundle import imgui

from glstar.viewer.overlays import Overlay
from glstar.viewer.session import Session
from glstar.viewer.trailresiduals import ResidualRequest, TrailResiduals
from glstar.viewer.ui.theme import error

__all__ = ["draw_residual_figures", "residuals_of"]


def residuals_of(session: Session) -> TrailResiduals | str | None:
    """Return the residuals of the real image shown, if they are shown.

    Parameters
    ----------
    session : Session

    Returns
    -------
    TrailResiduals, str or None
        Or why there are none; None while they are measured, without a real image, and if they are not shown.
    """
    comparison, loaded = session.comparison, session.loaded
    if Overlay.RESIDUALS not in session.shown_overlays or loaded is None or comparison.residuals.measure is None:
        return None
    image = comparison.image_at(loaded.head.utc_s)
    if image is None:
        return None
    request = ResidualRequest(
        loaded.simulator,
        comparison.ahead_s,
        image,
        session.config.exposure.starting_at(0.0),
        comparison.time_reference,
        comparison.match_exposure,
    )
    return comparison.residuals.of(request)


def draw_residual_figures(session: Session) -> None:
    """Draw the switch of the residuals and their figures into the current imgui window.

    Parameters
    ----------
    session : Session
    """
    if session.comparison.images is None or session.comparison.residuals.measure is None:
        return
    imgui.separator_text("Residuals")
    is_shown = Overlay.RESIDUALS in session.shown_overlays
    if imgui.checkbox("arrows and figures", is_shown)[0]:
        session.shown_overlays ^= {Overlay.RESIDUALS}
    imgui.set_item_tooltip("measures each trail of the real image against the simulated one, as glstar compare")
    found = residuals_of(session)
    if isinstance(found, TrailResiduals):
        imgui.text_disabled(f"{len(found.shift_px)} of {found.predicted} trails found; simulated minus real")
        if imgui.begin_table("##residuals", 2, int(imgui.TableFlags_.sizing_fixed_fit)):
            for label, value in found.figures:
                imgui.table_next_column()
                imgui.text_disabled(label)
                imgui.table_next_column()
                imgui.text_unformatted(value)
            imgui.end_table()
    elif found is not None:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_colored(error(), found)
        imgui.pop_text_wrap_pos()
    elif session.comparison.residuals.is_running:
        imgui.text_disabled("measuring ...")
