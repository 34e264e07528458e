"""The flight log: writer, reader, recovery and the pictures made from it."""
