"""The arm on ROS: a core without ROS types, and thin skins on it (`docs/ros.md`)."""
