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

# Card games.
RED: Colour = (255, 0, 0)
PALE_BLUE: Colour = (173, 217, 230)
SCARLET: Colour = (255, 48, 71)
HOT_PINK: Colour = (255, 105, 186)
SMOKE: Colour = (245, 245, 245)
SLATE_BLUE: Colour = (153, 179, 204)
CRIMSON: Colour = (191, 26, 26)
PALE_GREEN: Colour = (143, 237, 143)
AZURE: Colour = (74, 191, 240)

# Tetris; SCARLET as well.
ASH: Colour = (128, 128, 128)
YELLOW: Colour = (255, 255, 0)
LAGOON: Colour = (0, 203, 225)
GOLD: Colour = (225, 206, 0)
VIOLET: Colour = (187, 0, 222)
EMERALD: Colour = (0, 226, 64)
BLOOD: Colour = (208, 0, 0)
COBALT: Colour = (0, 119, 220)
AMBER: Colour = (215, 144, 0)

# Skittles; YELLOW as well.
GREEN: Colour = (0, 255, 0)
BLUE: Colour = (0, 0, 255)
ULTRAVIOLET: Colour = (125, 0, 237)
CANARY: Colour = (255, 245, 0)

# Breakout; SCARLET and YELLOW as well.
SLATE: Colour = (119, 122, 127)
BRICK_RED: Colour = (200, 72, 72)
RUST: Colour = (198, 108, 58)
TANGERINE: Colour = (255, 122, 48)
OLIVE: Colour = (162, 162, 42)
LIME: Colour = (72, 255, 72)
INDIGO: Colour = (66, 72, 200)
FLAME: Colour = (255, 50, 50)

# BattleShip; GREY, ORANGE, RED, SKY as well.
NICKEL: Colour = (191, 191, 191)
BRASS: Colour = (217, 166, 33)

# Navigator; RED, SKY, SLATE, YELLOW as well.
MAUVE: Colour = (119, 112, 127)
MIDNIGHT: Colour = (0, 0, 127)
PLUM: Colour = (138, 0, 138)
