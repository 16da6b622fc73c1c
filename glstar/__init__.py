"""glstar: what a camera bolted to an aircraft sees of the night sky during a long exposure.

Importing it opens no window, makes no OpenGL context and loads none of the libraries that could.
"""

__version__ = "0.1.0"
