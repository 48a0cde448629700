"""Colours of all figures."""

#: Colours that stay apart for colour-blind readers [28].
BLUE, ORANGE, GREEN, VERMILION, PURPLE, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#666666"
#: For sag about zero: dark at both ends, light in the middle, safe for colour-blind readers.
DIVERGING = "RdBu_r"
