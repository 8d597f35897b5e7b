"""The plan language: what the embedded model writes in place of JSON.

A plan over the words of its instruction. Names, texts and quantities are not spelt but pointed at, by the numbers of
the first and last word, so that a name that no training data has is copied whole; a subtask takes about ten tokens.

    w0 Rex w1 , w2 fetch w3 the w4 drill w5 from w6 bay w7 2 w8 .        the instruction, its words numbered
    manipulation | goto w0 w0 place w6 w7 | pick w0 w0 object w4 w4 < 1  the plan
    none question                                                       or why there is none

`words` cuts an instruction into numbered words, `values` says what a run of words means as a name, a free text or a
quantity, `codec` turns plans into symbols and back.
"""
