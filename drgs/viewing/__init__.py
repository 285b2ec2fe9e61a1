"""A viewer in the browser, by viser: the client draws Gaussians, and our own image comes where its camera rests.

gate          which requests are answered: addresses, tokens, origins
gated_viser   viser's server behind the gate
server        a session for every browser
session       one browser: what it shows, where its camera rests, what it is sent
keyframes     the folder of keyframes in its panel
panel         what stands in the panel, as escaped HTML
subject       the scene or run that is shown
layers        which pictures of it there are, and how they are drawn in steps
worker        the one thread that computes
client        the browser's cameras and Gaussians, and ours
placed_views  where photographs were taken, or could be
installation  whether viser is installed, and what is said where it is not
"""

from drgs.checks.imports import modules_of

__getattr__ = modules_of(__name__)
