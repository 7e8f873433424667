"""Pictures of what the operator must do, for a terminal: plain ASCII, at most 60 columns."""

BOARD_UPRIGHT = r"""
  from the side                 from above

              |  board            ___________
              |  upright         /           \
  camera      |                 |  =========  |  board across,
   [O]=  - - -|- -              |      +      |  over the axis
         _____|_____             \___________/
        |_platter___|                 [O] camera
"""

BOARD_BACK = r"""
  from the side                 from above

               /  board           ___________
              /   leans back     /           \
  camera     /    by 30 deg     |  =========  |  board across,
   [O]=  - -/- -                |      +      |  over the axis
         __/________             \___________/
        |_platter___|                 [O] camera
"""

BOARD_LEFT = r"""
  as the camera sees it         from above

     _____                        ___________
    /    /|  turned a little     /           \
   /____/ |  in its plane       |=====  +     |  at the left
   |____|/                      |             |  edge
   ___________                   \___________/
  |_platter___|                       [O] camera
"""

BOARD_RIGHT = r"""
  as the camera sees it         from above

        _____                     ___________
       |\    \  leans back by    /           \
       | \____\ 15 deg, turned  |     +  =====|  at the right
        \|____| the other way   |             |  edge
   ___________                   \___________/
  |_platter___|                       [O] camera
"""

CARD = r"""
  from the side                 as the camera sees it

  camera   |                     ___________________
   [O]=  - |  card, grey or     |                   |
           |  white, near the   |   card, and only  |
           |  lens, lit evenly  |   card            |
         __|________            |___________________|
        |_platter___|
"""

ROTATE_LEFT = r"""
  from above: counter-clockwise, by hand, until almost taut

          .--<--.
         /       \
        v    +    |===== cable
         \       /
          '-->--'
"""

ROTATE_RIGHT = r"""
  from above: clockwise, by hand, until almost taut

          .-->--.
         /       \
        |    +    v===== cable
         \       /
          '--<--'
"""

CABLE_FREE = r"""
  from the side: the cable hangs free

         ___________
        |_platter___|
            |   )
          [servo] )___ cable
"""

OBJECT_AT_MARK = r"""
  from above

          ___________
         /    ___    \
        |    |_o_|    |   the same mark,
        |      v      |   the same side to the camera
         \___________/
             [O] camera
"""
