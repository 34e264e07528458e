"""Pictures of a flight: the map, the strips and the video, from a log or from a flight in memory."""
