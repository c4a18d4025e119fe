"""How well a viewpoint explains what was said: queries, fits, scans."""
