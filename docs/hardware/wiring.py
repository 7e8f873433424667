"""The wiring diagram of docs/how-to/build-the-table.md."""

from html import escape

BOXES = {  # left, top, width, height, lines of text; the first is the title
    "supply": (30, 40, 190, 76, ("12 V supply", "at least 2 A, protected", "against short circuits")),
    "button": (270, 40, 190, 76, ("Emergency stop button", "latching, normally closed", "contact in the + wire")),
    "hub": (510, 40, 190, 76, ("U2D2 power hub", "(PHB)", "screw terminal: + and −")),
    "servo": (750, 40, 190, 76, ("Servo XL430", "below the deck")),
    "u2d2": (510, 190, 190, 76, ("U2D2", "USB to TTL")),
    "camera": (270, 340, 190, 76, ("Camera", "on the post")),
    "computer": (510, 340, 190, 170, ("Raspberry Pi 5", "USB", "USB", "I2C bus 1, pins 1 3 5 6")),
    "imu": (750, 340, 190, 170, ("IMU (GY-521)", "VCC", "GND", "SDA", "SCL", "AD0, to GND on the board")),
}
WIRES = [  # colour, points, label, place of the label
    ("#c0392b", [(220, 68), (270, 68)], "+", (240, 60)),
    ("#c0392b", [(460, 68), (510, 68)], "+", (480, 60)),
    ("#2c3e50", [(125, 116), (125, 150), (605, 150), (605, 116)], "− (GND), not through the button", (270, 144)),
    ("#8e44ad", [(700, 78), (750, 78)], "3 pins", (704, 70)),
    ("#2471a3", [(640, 116), (640, 190)], "3-pin TTL cable", (648, 176)),
    ("#2471a3", [(605, 266), (605, 340)], "USB cable", (613, 308)),
    ("#2471a3", [(460, 378), (510, 378)], "USB", (469, 370)),
    ("#c0392b", [(700, 392), (750, 392)], "1", (706, 387)),
    ("#2c3e50", [(700, 414), (750, 414)], "6", (706, 409)),
    ("#b7950b", [(700, 436), (750, 436)], "3", (706, 431)),
    ("#1e8449", [(700, 458), (750, 458)], "5", (706, 453)),
]
NOTES = (
    "VCC is 3.3 V from pin 1 of the Raspberry Pi. Never connect 5 V to the IMU of this diagram.",
    "The four wires of the IMU are the ribbon in the drum. The Pi has its own supply by USB-C.",
    "The button cuts the servo's 12 V only. Computer, IMU and camera stay on, and the rig reports a lost supply.",
)


def picture() -> str:
    """Return the diagram as an SVG document."""
    lines = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 970 610" font-family="sans-serif" font-size="13"',
        ' fill="#222">',
        "<title>Wiring of the bench: supply, emergency stop button, power hub, servo, U2D2, camera and IMU</title>",
        '<rect width="970" height="610" fill="#fff"/>',
    ]
    for colour, points, text, (x, y) in WIRES:
        path = " ".join(f"{px},{py}" for px, py in points)
        lines.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="3"/>')
        lines.append(f'<text x="{x}" y="{y}" font-size="12" fill="{colour}">{escape(text)}</text>')
    for name, (left, top, width, height, words) in BOXES.items():
        fill = "#fdecea" if name == "button" else "#f4f6f8"
        lines.append(
            f'<rect x="{left}" y="{top}" width="{width}" height="{height}" rx="6" fill="{fill}"'
            ' stroke="#445" stroke-width="1.5"/>'
        )
        for number, word in enumerate(words):
            style = ' font-weight="bold"' if number == 0 else ""
            y = top + 22 + (22 if height > 100 else 18) * number + (8 if height > 100 and number else 0)
            lines.append(f'<text x="{left + 12}" y="{y}"{style}>{escape(word)}</text>')
    lines += [f'<text x="30" y="{546 + 22 * i}">{escape(note)}</text>' for i, note in enumerate(NOTES)]
    return "\n".join([*lines, "</svg>", ""])
