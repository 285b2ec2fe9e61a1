"""A scene as one HTML file that opens from disk: what it holds, and the viewer from npm that draws it."""
