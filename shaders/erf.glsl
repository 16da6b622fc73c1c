// The error function, Abramowitz & Stegun 7.1.26, to 1.5e-7: erf(x) = 1 - ERFC_POLYNOMIAL(t) exp(-x^2) for x >= 0,
// with t = 1 / (1 + ERF_P x).  A macro, because t is a vec2 or a vec4.

const float ERF_P = 0.3275911;

#define ERFC_POLYNOMIAL(t) (t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429)))))
