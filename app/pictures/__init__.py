"""Pictures without a viewer: one palette, panels, sheets."""

from selective_depth.app.pictures.panels import Panel, panels_of
from selective_depth.app.pictures.sheets import Row, alone, contact_rows, contact_sheet, sheet, write_picture

__all__ = ["Panel", "Row", "alone", "contact_rows", "contact_sheet", "panels_of", "sheet", "write_picture"]
