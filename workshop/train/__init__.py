"""Training of the embedded planner, from the hand-written pairs to a model folder for the local slot.

`examples` turns pairs into words and symbols, `lexicon` holds the nouns that variation draws from, `vary` makes an
example another one with an exact plan (`reword`: its words; `linking`: who waits for whom; `crews`: who does it;
`listing`: to what), `splits` sets apart what must not be trained on, `tokens` makes the tokenizer.
`fit` trains, `judge` counts, `export` makes the folder: these need the extra `train` (PyTorch).
"""
