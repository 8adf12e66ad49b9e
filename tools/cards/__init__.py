"""Cards of memory models: laws, cost, speed, what they remember and for how long, on one page.

`reach` measures how far back inputs matter, `measure` everything that a card says, `study` what
agents with the memory learn, `page` writes it down.
"""
