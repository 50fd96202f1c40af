"""Pages are opened in a headless browser."""

from browsing import browser, open_page

__all__ = ["browser", "open_page"]
