"""Reports of results: text, JSON, CSV and an HTML page; and the 3D view."""
