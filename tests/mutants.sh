#!/usr/bin/env bash
# mutants.sh [--applies] [TEXT]: do the tests detect bugs? Each mutant is one wrong line in a copy of the headers and a
# test that must fail with it. Fails if a mutant survives, does not compile or no longer applies. With TEXT, only the
# mutants whose line in the table below contains it. Not part of run.sh: about 30 programs are compiled, JOBS (default:
# all cores) at a time.
# CC (default gcc) and CFLAGS (default -O1) as usual. With --applies nothing is compiled: it only checks that each
# substitution still changes its file, which run.sh does.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# FILE | TEST (tests/TEST.c) | what is wrong | substitution, as perl takes it (over the whole file; it must change something)
table() {
    cat << 'END'
gsfixer.h|test_gsfixer|JSON strings hold raw characters from 0x10 on|s/if \(c < 0x20\) return gsf__json_fail/if (c < 0x10) return gsf__json_fail/
gsfixer.h|test_gsfixer|JSON escapes of control characters are short|s/\\\\u%04x/\\\\u%03x/
gsfixer.h|test_resize|bicubic with a = -0.75, as OpenCV has it|s/const double a = -0\.5;/const double a = -0.75;/
gsfixer.h|golden_metrics|SSIM: constants without their squares|s/c1 = gsf__vd_set\(0\.01 \* 0\.01\), c2 = gsf__vd_set\(0\.03 \* 0\.03\)/c1 = gsf__vd_set(0.01), c2 = gsf__vd_set(0.03)/
gsfixer_nn.h|test_nn_vae|Winograd: a sign of the lower outputs|s/GSF_X\(3, \(u1 - u2\) - u3\)/GSF_X(3, (u1 - u2) + u3)/
gsfixer_nn.h|test_nn_training|gradient of attention in bf16: dk is that of dy|s/b->packed, keys, q_across/b->packed, keys, dy_across/
gsfixer_nn.h|test_nn_gradients|gradients: Winograd's weights, a sign|s/\(p\) - \(q\), left\);/(p) + (q), left);/
gsfixer_nn.h|golden_metrics|LPIPS: features are not rectified|s/return gsf__v_max\(gsf__v_set\(0\.0f\), x\); \} \/\/ a NaN remains/return x; }/
gsfixer_traj.h|golden_traj|slerp is a straight line|s/wa = gsf__sin_f64\(angle \* \(1\.0 - t\)\) \/ gsf__sin_f64\(angle\);/wa = 1.0 - t;/
gsfixer_traj.h|golden_traj|windows overlap by one frame less|s/each = shared \/ \((\w+\.)?windows - 1\);/each = shared \/ ($1windows - 1) - 1;/
gsfixer_traj.h|test_rules|restored views weigh t^2, not t (2 - t)|s/t \* \(2\.0f - t\)/t * t/
gsfixer_splat.h|test_rules|photos and restored views averaged together|s/densify_mean\(model->grad_sum\[k\]\[i\], model->visits\[k\]\[i\]\)/densify_mean(model->grad_sum[k][i], model->visits[0][i] + model->visits[1][i])/
gsfixer_splat.h|test_rules|restored views counted as photos|s/model->grad_sum\[k\]\[i\] \+= gsf__visit_grad/model->grad_sum[0][i] += gsf__visit_grad/
gsfixer_splat.h|test_rules|an origin from 2000 extents on|s/distance > 1000\.0 \* extent/distance > 2000.0 * extent/
gsfixer_splat.h|test_rules|warp: a nearer group needs half the weight|s/(define GSF__WARP_GROUP_SHARE) 0\.35f/$1 0.5f/
gsfixer_splat.h|test_rules|warp: what is in front of the frame's surface is trusted|s/trust = in_front \? GSF__WARP_IN_FRONT :/trust = in_front ? 1.0f :/
gsfixer_splat.h|test_rules|warp: what photos look through hides, too|s/if \(hidden && through < \(few \? 2 : 1\)\)/if (hidden)/
gsfixer_splat.h|test_rules|warp: one of few photos that looks through makes a floater|s/\(few \? 2 : 1\)/1/
gsfixer_splat.h|test_rules|dense points: min_angle of 2 degrees|s/(d\.min_angle = \D*)1\.0f/${1}2.0f/
gsfixer_splat.h|test_rules|dense points: max_normal_angle of 60 degrees|s/d\.max_normal_angle = 40\.0f/d.max_normal_angle = 60.0f/
gsfixer_splat.h|test_carry|filter: a view alone changes where light passes the splats, too|s/share = by_opacity \? gsf__get_pixel\(alpha, x, y, 0\)/share = by_opacity ? 1.0f/
gsfixer_splat.h|test_stereo|dense points: normals are not compared|s/return dot >= job->min_normal_dot/return dot >= -1.0f/
gsfixer_splat.h|test_stereo|dense points: coarse levels match grey|s/job->channels = level \? 3 : 1/job->channels = 1/
gsfixer_splat.h|compile/render_only|SH: a basis function of degree 3 changes sign|s/(basis\[10\] = gsf__v_set\()2\.890611442640554f/${1}-2.890611442640554f/
gsfixer_splat.h|golden_splat|blend: a pixel that becomes finished goes on|s/(else if \(_mm256_movemask_ps\(_mm256_cmp_ps\(T, least, _CMP_GE_OQ\)\)) != 255\) return 0;/$1 > 255) return 0;/
gsfixer_splat.h|test_stress|keep: a step that is blended again keeps the places after its own|s/place\[gsf__lowest_bit\(left\)\]--/place[gsf__lowest_bit(left)]/g
gsfixer_splat.h|golden_splat|gather: the last sums of a slot are left out|s/PARTS = \(GSF__SLOT_SUMS \+ WIDE - 1\) \/ WIDE/PARTS = GSF__SLOT_SUMS \/ 2 \/ WIDE/
gsfixer_splat.h|golden_splat|densification splits what it should clone|s/<= clone_log \? GSF__CLONE : GSF__SPLIT/<= clone_log ? GSF__SPLIT : GSF__CLONE/
gsfixer_splat.h|golden_splat|opacity reset raises opacities|s/if \(group->value\[i\] > logit\)/if (group->value[i] < logit)/
gsfixer_splat.h|golden_splat|opacity reset keeps the second moments|s/(group->value\[i\] = logit;\s*memset\(group->m,[^;]*;)\s*memset\(group->v,[^;]*;/$1/
gsfixer_splat.h|test_trainer|MCMC: splats clamped to prune_opacity count as dead|s/(dead \+= model->groups\[GSF__OPACITY\]\.value\[i\]) < logit/$1 <= logit/
gsfixer_splat.h|test_visibility|visible points: a tolerance of zero is refused|s/("tolerance", \(double\)d->tolerance, )0,/${1}FLT_MIN,/
gsfixer_splat.h|test_carry|exposure: the camera exposes brighter views more|s/const double slope = -product/const double slope = product/
gsfixer_splat.h|test_fixer|warp: bytes of photos divided by 256|s/\(plane\[taps->at\[k\] \* channels \+ channel\] \/ one\)/(plane[taps->at[k] * channels + channel] \/ (one + 1.0))/
gsfixer_splat.h|test_scene|PLY: f_rest is written coefficient by coefficient|s/gsf__put_f32\(p, sh\[3 \* k \+ channel\]\)/gsf__put_f32(p, sh[3 * (1 + (channel * (bands - 1) + k - 1) \/ 3) + (channel * (bands - 1) + k - 1) % 3])/
gsfixer_splat.h|test_scene|undistortion: tangential terms swapped|s/\*u = x \* scale \+ 2\.0 \* k\[2\] \* x \* y \+ k\[3\] \*/*u = x * scale + 2.0 * k[3] * x * y + k[2] */
gsfixer_nn.h|golden_restorer|RoPE: frequencies of the next pair|s/exponent = \(float\)k \/ \(float\)dim/exponent = (float)(k + 2) \/ (float)dim/
gsfixer_nn.h|golden_restorer|adaLN: the text takes the video's shift and scale|s/m \+ 4 \* d, m \+ 3 \* d/m + d, m/
gsfixer_nn.h|golden_restorer|schedule: betas are not rescaled to zero terminal SNR|s/no_zero_snr = !rescale/no_zero_snr = 1/
gsfixer_splat.h|test_fixer|copies: what differs is not taken back|s/kept < 1\.0f \? kept : 1\.0f/1.0f/
gsfixer_splat.h|test_fixer|copies: the variance is divided by their number|s/3\.0f \* \(float\)\(copies - 1\)/3.0f * (float)copies/
gsfixer_splat.h|test_fixer|joined copies: each keeps its opacity|s/thickness \/ \(double\)d->copy_count/thickness/
gsfixer_splat.h|test_fixer|joined copies: frames of their own splats|s/if \(f->desc\.copy_count > 0\)/if (0)/
gsfixer_splat.h|test_fixer|joined copies: dropout goes on|s/d\.train\.dropout = 0\.0f;/;/
gsfixer_splat.h|test_fixer|frames of warp are mixed in whatever their confidence|s/weight \* gsf__get_pixel\(f->warped_confidence \+ i, x, y, 0\)/weight/
gsfixer_nn.h|test_nn_mini|mini: guesses are trained on where no photo shows anything|s/const int known = gsf__mini_shows\(shown, r->desc\.references, plane\)/const int known = 1/
gsfixer_nn.h|test_nn_scheduler|schedule: trailing steps are one too late|s/\(int32_t\)rint\(n \+ i \* difference\) - 1/(int32_t)rint(n + i * difference)/
gsfixer_nn.h|test_nn_training|gradients: SiLU without its second term|s/return s \* \(1\.0 \+ x \* \(1\.0 - s\)\);/return s;/
gsfixer_nn.h|test_nn_training|gradients: softmax as if its values were independent|s/(gsf__vf slope = gsf__v_load_first\(dy \+ i, left\)) - sum;/$1;/
gsfixer_nn.h|test_nn_training|gradients: the mean of a norm is taken as constant|s/t\.h - mean\)/t.h)/
gsfixer_nn.h|test_nn_training|gradients: a norm's scale without its bias|s/weight \* product \+ bias \* sum\)/weight * product)/
gsfixer_nn.h|test_nn_training|gradients: rows of x taken without their stride|s/multiply\.ldw = d->ldx;/multiply.ldw = 0;/
gsfixer_nn.h|test_nn_training|gradients: GELU without the density|s/gsf__v_madd\(gsf__v_with_sign\(z, x\), power \* gsf__v_set\(0\.398942280f\), below\)/below/
gsfixer_nn.h|test_nn_training|gradients: attention's keys across blocks not centred alike|s/(b\.k\[j \* job->pitch \+ i\] = d->k\[[^;]*\]) - b\.center\[i\]/$1/
gsfixer_nn.h|test_nn_gradients|gradients: the rotary embedding turned on instead of back|s/(gsf__v_turn_pairs\(d, gsf__v_load_first\(cos \+ i, left\)), zero - (gsf__v_load_first\(sin \+ i, left\)\))/$1, $2/
gsfixer_nn.h|test_nn_gradients|gradients: group norm without its slope|s/n\.inverse \* gsf__v_nmadd\(normal, slope, h\)/n.inverse * h/
gsfixer_nn.h|test_nn_gradients|gradients: convolution kernels not mirrored|s/\+ o\) \* taps \+ gsf__conv_flip\(t, layer->kernel\)/+ o) * taps + t/
gsfixer_nn.h|test_nn_gradients|gradients: frames before the first get none of a convolution|s/if \(job\.out\) gsf__conv_frame/if (job.out \&\& s >= 0) gsf__conv_frame/
gsfixer_nn.h|test_nn_gradients|gradients: warping forgets the weights of its taps|s/b->weight\[to\] = f->weight\[k\];/b->weight[to] = 1.0f;/
gsfixer_nn.h|test_nn_gradients|gradients: the candidates of a blend as if independent|s/dlogits\[k\] = weight\[k\] \* \(dlogits\[k\] - mean\)/dlogits[k] *= weight[k]/
gsfixer_nn.h|golden_training|training: references get no gradient from the values|s/(&block->cross\.v, t->references, r, t->dv, t->dreferences, 1\))/&block->cross.v, t->references, r, t->dv, t->dn, 0)/
gsfixer_nn.h|golden_training|training: the gates of text for the video|s/(t->dx \+ at, run->video, d, t->db \+ at,\s*t->dm \+) GSF__DIT_VIDEO_GATE/$1 GSF__DIT_TEXT_GATE/
gsfixer_nn.h|golden_training|training: gradients are not clipped|s/job\.terms\.scale = \(float\)\(mean \* clip\)/job.terms.scale = (float)mean/
gsfixer_nn.h|golden_training|training: weight decay goes through the moments' rate only|s/1\.0 - rate \* d->weight_decay/1.0 - 0.0 * d->weight_decay/
gsfixer_nn.h|test_nn_gradients|gradients: depthwise kernels not mirrored|s/mirrored \? taps - 1 - t : t/t/
gsfixer_nn.h|golden_training|training: a resumed run forgets its step|s/params->step = count;/params->step = 0;/
gsfixer_nn.h|test_nn_training|gradients: attention's weights as if independent|s/\(gsf__v_load_first\(dp \+ j, left\) - less\)/gsf__v_load_first(dp + j, left)/
END
}

work=$(mktemp -d)
chmod 755 "$work" # test_scene reads as another user
trap 'rm -rf "$work"' EXIT
export OMP_NUM_THREADS=1

# Builds a standalone test program as tests/CMakeLists.txt does, but without the optional libraries.
build() { # TEST HEADERS PROGRAM
    mkdir "$3.tmp"
    ${CC:-gcc} -std=c11 ${CFLAGS:--O1} -w -DNDEBUG -DGSFIXER_STATIC -DGSFIXER_IMPLEMENTATION= -I"$2" -Itests \
        -DTEST_GOLDEN="\"$PWD/tests/golden\"" -DTEST_TMP="\"$3.tmp\"" "tests/$1.c" -o "$3" -lm -pthread 2> "$3.log"
}

# The tests must pass on the unchanged headers, otherwise a failure proves nothing.
baseline() { # TEST
    local program=$work/baseline.${1//\//.}
    build "$1" . "$program" || { echo "$1: does not compile"; return 1; }
    timeout 600 "$program" > "$program.log" 2>&1 || { echo "$1: fails on the headers as they are"; tail -n 5 "$program.log"; return 1; }
}

mutant() { # NUMBER LINE
    local file test what edit verdict headers=$work/$1
    IFS='|' read -r file test what edit <<< "$2"
    mkdir "$headers"
    cp gsfixer*.h "$headers"
    if ! perl -0pi -e "$edit" "$headers/$file" || cmp -s "$file" "$headers/$file"; then
        verdict="DOES NOT APPLY"
    elif ! build "$test" "$headers" "$headers/program"; then
        verdict="DOES NOT COMPILE"
    elif timeout 600 "$headers/program" > "$headers/log" 2>&1; then
        verdict=SURVIVED
    else
        verdict=killed
    fi
    printf '%-16s  %-16s  %-19s  %s\n' "$verdict" "$file" "$test" "$what" > "$work/result.$1"
    rm -rf "$headers"
}

all() { # COMMAND ITEM...: runs JOBS of them at a time
    local command=$1 item n=0
    shift
    for item in "$@"; do
        while [ "$(jobs -rp | wc -l)" -ge "${JOBS:-$(nproc)}" ]; do wait -n || true; done
        n=$((n + 1))
        $command "$item" $n &
    done
    wait
}
checked_baseline() { baseline "$1" > "$work/note.$2" || mv "$work/note.$2" "$work/bad.$2"; }
numbered_mutant() { mutant "$(printf '%03d' "$2")" "$1"; }

applies() { # LINE NUMBER
    local file test what edit
    IFS='|' read -r file test what edit <<< "$1"
    perl -0pe "$edit" "$file" > "$work/$2"
    ! cmp -s "$file" "$work/$2" || echo "DOES NOT APPLY  $file  $test  $what" > "$work/bad.$2"
}

only_applies=0
[ "${1:-}" != --applies ] || { only_applies=1; shift; }
mapfile -t lines < <(table | grep -F -- "${1:-}")
[ ${#lines[@]} -gt 0 ] || { echo "mutants.sh: no mutant of that name" >&2; exit 2; }
if [ $only_applies = 1 ]; then
    all applies "${lines[@]}"
    if compgen -G "$work/bad.*" > /dev/null; then cat "$work"/bad.*; exit 1; fi
    echo "${#lines[@]} mutants apply"
    exit 0
fi
mapfile -t tests < <(printf '%s\n' "${lines[@]}" | cut -d'|' -f2 | sort -u)
all checked_baseline "${tests[@]}"
if compgen -G "$work/bad.*" > /dev/null; then cat "$work"/bad.*; exit 1; fi
all numbered_mutant "${lines[@]}"
cat "$work"/result.*
killed=$(cat "$work"/result.* | grep '^killed' | wc -l)
echo "${#lines[@]} mutants, $killed killed"
[ "$killed" = ${#lines[@]} ]
