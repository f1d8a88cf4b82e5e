"""An encoder on the Hugging Face Hub: ``sb3-abisim push FILE owner/name``.

A repository holds ``model.safetensors`` (the encoder file, byte for byte), ``config.json`` (what builds and describes
it) and ``README.md`` (front matter as the Hub reads it, how to use the encoder, how it was made, and the evidence).
Nothing in it is code, and nothing executes when it is loaded: ``hf://owner/name@COMMIT`` in place of a file's name.
"""
