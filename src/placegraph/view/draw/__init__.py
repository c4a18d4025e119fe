"""What every picture is made of: canvas, painter, letters, sheets."""
