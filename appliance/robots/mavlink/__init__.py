"""MAVLink: frames in and out over UDP, what is known of each vehicle, the command and mission protocols."""
