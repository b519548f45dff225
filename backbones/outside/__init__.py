"""What others bring: plug-ins, a class or a function in a file, a network in a file; checked where it comes in."""
