"""The page: all cards in order, refreshed from one snapshot a few times a second."""

from nicegui import app, ui
from starlette.middleware.trustedhost import TrustedHostMiddleware

from dm_tools.console import HOST, style
from dm_tools.console.console_node import ConsoleNode
from dm_tools.console.session import Session
from dm_tools.console.surface_view import SurfaceView
from dm_tools.console.widgets.actuators import ActuatorCards
from dm_tools.console.widgets.calibration import CalibrationCard, RecipesCard
from dm_tools.console.widgets.focus import FocusCard
from dm_tools.console.widgets.messages import DiagnosticsCard, Header, LogCard
from dm_tools.console.widgets.surfaces import SurfaceCard, ZernikeCard

#: The check of host names also keeps foreign web sites from reaching the mirror through the browser.
HOST_NAMES = [HOST, "localhost"]
REFRESH_S = 0.3
#: A page that was disconnected for longer is reloaded and loses typed values, s; long enough for a sleeping phone.
RECONNECT_S = 60.0


def serve(ros: ConsoleNode, port: int) -> None:
    """Serve the console on loopback until Ctrl-C; the caller closes `ros`."""
    session = Session(ros)
    view = SurfaceView(ros.observer)
    ui.page("/")(lambda: build(session, view))
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=HOST_NAMES)
    app.on_shutdown(session.end)
    # Quasar's loading bar has no name for screen readers, and says nothing about the mirror.
    app.config.quasar_config["loadingBar"]["skipHijack"] = True
    ui.run(
        host=HOST,
        port=port,
        title="Deformable mirror console",
        language="en-GB",
        dark=None,  # as set in the system
        reload=False,
        show=False,
        show_welcome_message=False,
        reconnect_timeout=RECONNECT_S,
    )


def build(session: Session, view: SurfaceView) -> None:
    """Put the cards on a new page."""
    ui.add_css(style.CSS)
    ui.colors(primary=style.PRIMARY, negative=style.ERROR, warning=style.WARNING)
    header = Header(session)
    with ui.element("div").classes("grid"):  # inside the page's own <main>
        with ui.element("div").classes("column side"):
            left = (FocusCard(session), CalibrationCard(session), RecipesCard(session))
        with ui.element("div").classes("column wide"):
            right = (SurfaceCard(session, view), ActuatorCards(session))
            with ui.element("div").classes("pair"):
                below = (ZernikeCard(view), LogCard(session))
            health = DiagnosticsCard()
    cards = (header, *left, *right, *below, health)

    def refresh() -> None:
        snapshot = session.snapshot()
        for card in cards:
            card.refresh(snapshot)

    refresh()
    ui.timer(REFRESH_S, refresh)
