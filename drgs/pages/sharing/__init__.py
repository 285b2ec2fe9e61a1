"""A scene as one HTML file that opens from disk, drawn by a viewer from npm.

scene       what the page of a run or of a file shows
write       the page, written
gaussians   its Gaussians, as an archive of SOG
layers      what is known of each of them: class, expected error, where it is at other times
placing     where the page's camera stands
page        the template, filled: page.html with loader.js, page.js, gaussians.js, cameras.js and panel.js
npm         the viewer's code, fetched by version and hash
"""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
