"""Drawing: canvas, painter, lettering, sheets."""
