"""Studies: many fits as cells that are kept and resumed, their statistics, and what a page says of them."""
