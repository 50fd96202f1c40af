"""From a field to files that other programs read: meshes, point clouds, videos, pictures, a page."""
