"""Fields to turn by hand in a browser, rendered here as the camera moves."""
