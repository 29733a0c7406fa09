"""Pictures without a viewer: one palette, panels, sheets."""
