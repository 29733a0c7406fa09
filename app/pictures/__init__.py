"""Pictures without a viewer: one palette, panels, sheets."""

from selective_depth.app.pictures.palette import STATE_COLOURS
from selective_depth.app.pictures.panels import Panel, depth_panel, error_panel, panels_of, shots_panel
from selective_depth.app.pictures.sheets import WIDTH_IN, Row, alone, contact_rows, contact_sheet, sheet, write_picture

__all__ = [
    "STATE_COLOURS",
    "WIDTH_IN",
    "Panel",
    "Row",
    "alone",
    "contact_rows",
    "contact_sheet",
    "depth_panel",
    "error_panel",
    "panels_of",
    "sheet",
    "shots_panel",
    "write_picture",
]
