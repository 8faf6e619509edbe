"""Identify the mass and friction of every cell of an unknown object by pushing it.

The stages, each a subpackage that imports only from those before it: `geometry`, `perception`, `pushing`, `physics`,
`identification`, `diagnosis`, `bags`, `offline`, `fleet`, `nodes`, `cli`. The types they share are in `types` and `errors`.
"""

__version__ = "0.1.0"
