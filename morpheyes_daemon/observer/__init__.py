"""The process that watches: page, flight log and journal lines, fed by the flight process and never waited for."""
