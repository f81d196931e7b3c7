"""Motion in joint space: controllers, planning, the guards behind every controller, the drive writers."""
