"""Every colour on any screen, by name; RGB, 0..255."""

Colour = tuple[int, int, int]

BLACK: Colour = (0, 0, 0)
CHARCOAL: Colour = (51, 51, 51)
GREY: Colour = (102, 102, 102)
SILVER: Colour = (204, 204, 204)
MIST: Colour = (229, 234, 242)
WHITE: Colour = (255, 255, 255)

ORANGE: Colour = (255, 127, 0)
SPRING_GREEN: Colour = (0, 255, 128)
SKY: Colour = (74, 214, 247)
NAVY: Colour = (0, 51, 102)
PURPLE: Colour = (153, 0, 204)
PINK: Colour = (245, 74, 140)
COPPER: Colour = (191, 120, 69)
